"""Runs kept for others: of every run what a report reads, its table compressed, no checkpoints."""

from __future__ import annotations

import gzip
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from safe_rl.runs.files import replacing
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
        ['config.yaml', 'progress.csv.gz']
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
    table = run.recorded_table
    with replacing(kept.packed_table) as unfinished:
        if table == run.table:
            # without a time, which would make other bytes of the same table
            unfinished.write_bytes(gzip.compress(table.read_bytes(), mtime=0))
        else:
            shutil.copyfile(table, unfinished)
    times = table.stat()
    os.utime(kept.packed_table, (times.st_atime, times.st_mtime))


def _small_files(run: RunFolder) -> Iterator[Path]:
    yield from (run.config, run.certificate)
    yield from (run.composed, run.overrides, run.surroundings)
    yield from run.evaluations()
