"""Runs kept for others: of every run what a report reads, its table compressed, no checkpoints.

Where on a machine a run was is nobody else's business, and is not kept but for what its command
line said itself.
"""

from __future__ import annotations

import gzip
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from omegaconf import OmegaConf

from safe_rl.runs.files import read_yaml, replace_text, replacing
from safe_rl.runs.folder import RunFolder

__all__ = ["keep_runs"]


def keep_runs(runs: Iterable[Path], root: Path, archive: Path) -> None:
    """Copy runs into an archive, each to where it is below its root.

    What is there already is replaced, so that an archive can be brought up to date while runs go
    on. The same runs make the same bytes, whenever they are copied.

    Args:
        runs: Folders of runs.
        root: Folder above all of them.
        archive: Folder of the archive, made if need be.

    Raises:
        ValueError: If the archive would be among the runs, or they in it.
        OSError: If something cannot be copied.

    Examples:
        >>> run, kept = getfixture("tiny_run").directory, getfixture("tmp_path") / "kept"
        >>> keep_runs([run], run, kept)
        >>> sorted(path.name for path in kept.iterdir() if path.is_file())
        ['code.json', 'config.yaml', 'progress.csv.gz']
    """
    here, there = root.resolve(), archive.resolve()
    if here.is_relative_to(there) or there.is_relative_to(here):
        raise ValueError(f"archive={archive}: it takes a folder beside {root}, not one within.")
    for run in runs:
        _keep(RunFolder(run), RunFolder(there / run.resolve().relative_to(here)))


def _keep(run: RunFolder, kept: RunFolder) -> None:
    kept.notes.mkdir(parents=True, exist_ok=True)
    for path in _small_files(run):
        if path.is_file() and not path.is_symlink():
            with replacing(kept.directory / path.relative_to(run.directory)) as unfinished:
                shutil.copyfile(path, unfinished)
    for path, text in _shortened(run):
        replace_text(kept.directory / path.relative_to(run.directory), text)
    table = run.recorded_table
    with replacing(kept.packed_table) as unfinished:
        if table == run.table:
            # without a time, which would make other bytes of the same table
            unfinished.write_bytes(gzip.compress(table.read_bytes(), mtime=0))
        else:
            shutil.copyfile(table, unfinished)


def _small_files(run: RunFolder) -> Iterator[Path]:
    yield from (run.config, run.code, run.certificate, run.overrides)


def _shortened(run: RunFolder) -> Iterator[tuple[Path, str]]:
    """Files that say where on its machine the run was, or things twice, with what a report reads.

    What is not as this package writes it is left out.
    """
    readers = dict.fromkeys(run.evaluations(), _evaluation_kept)
    notes = {run.surroundings: _surroundings_kept, run.composed: _composed_kept}
    for path, reader in {**readers, **notes}.items():
        if path.is_file() and not path.is_symlink():
            with suppress(ValueError, LookupError, TypeError, AttributeError, RecursionError):
                yield path, reader(path)


def _evaluation_kept(path: Path) -> str:
    """An evaluation without the folder of its run, which is the one that it lies in."""
    content = json.loads(path.read_text(encoding="utf-8"))
    content.pop("run", None)
    content["checkpoint_file"] = Path(content["checkpoint_file"]).name
    return json.dumps(content, indent=2) + "\n"


def _surroundings_kept(path: Path) -> str:
    """Of Hydra's configuration its version, and the folders that the command line has named."""
    runtime = read_yaml(path)["hydra"]["runtime"]
    sources = [s for s in runtime["config_sources"] if s["provider"].endswith("command-line")]
    if start := runtime.get("cwd"):  # an archive's has none
        # as a person would type them where the run was started
        sources = [{**s, "path": os.path.relpath(s["path"], start)} for s in sources]
    kept = {"version": runtime["version"], "config_sources": sources}
    return OmegaConf.to_yaml({"hydra": {"runtime": kept}})


def _composed_kept(path: Path) -> str:
    """How long the run was to be at first; all else stands in its configuration."""
    return OmegaConf.to_yaml({"frames": read_yaml(path)["frames"]})
