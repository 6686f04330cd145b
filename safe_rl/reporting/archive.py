"""Find the runs below a folder, in folders of their own and in archives; write archives.

An archive has two files. ``runs.json.gz`` has a line per run, with its configuration and notes.
``rows.csv.gz`` has the epochs of all runs, with the run in the first column. Files that cannot be
read are left out, with a reason.
"""

from __future__ import annotations

import gzip
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from safe_rl.extras import import_extra
from safe_rl.files import read_config, read_json, read_yaml, replacing
from safe_rl.reporting.recorded import Run, read_certificate, read_code, read_evaluation, select
from safe_rl.reporting.tables import clean
from safe_rl.runs.folder import paths_below
from safe_rl.runs.identity import differences, role_of
from safe_rl.runs.run import Run as RunFolder
from safe_rl.runs.run import find_runs as find_folders
from safe_rl.runs.table import read_table

RUNS, ROWS = "runs.json.gz", "rows.csv.gz"


def find_runs(root: Path, *, unfinished: bool = False) -> tuple[list[Run], dict[Path, str]]:
    """Find every run below a folder, in folders of their own and in archives.

    Args:
        root: The folder.
        unfinished: Whether runs count as finished that have not reached their configured end.

    Returns:
        Runs that have finished an epoch, and folder or file -> the reason why it is left out.

    Raises:
        FileNotFoundError: If there is no such folder, or no run in it.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"There is no folder '{root}': give the folder of the runs.")
    found: list[Run] = []
    skipped: dict[Path, str] = {}
    for path in paths_below(root, RUNS):
        with _noted(path, skipped):
            found += read_archive(path.parent).values()
    for folder in find_folders(root):
        with _noted(folder.directory, skipped):
            found.append(_read_run(folder, skipped))
    runs = []
    for run in found:
        with _noted(run.directory, skipped):
            run.check()
            runs.append(replace(run, takes_part=unfinished))
    if not runs:
        reasons = "".join(f"\n  {clean(path)}: {reason}" for path, reason in skipped.items())
        raise FileNotFoundError(
            f"There is no run to report below '{root}': a run is a folder with config.yaml and "
            f"progress.csv, as train.py writes it.{reasons}"
        )
    return sorted(runs, key=lambda run: run.directory), skipped


@contextmanager
def _noted(path: Path, skipped: dict[Path, str]) -> Iterator[None]:
    """Note the error of the block as the reason why a folder or file is left out."""
    try:
        yield
    except Exception as error:  # files of unknown origin may hold anything
        is_told = isinstance(error, ValueError | OSError)
        reason = error if is_told else f"{path.name} is not as a run writes it ({error!r})"
        skipped[path] = clean(reason)


def _read_run(folder: RunFolder, skipped: dict[Path, str]) -> Run:
    """Read a run from its folder; notes that cannot be read are left out."""

    def read(path: Path, check: Callable[[Any], object] = bool) -> Any:
        """The content of a file; None if there is no file, or it fails the check."""
        with _noted(path, skipped):
            if path.exists():
                content = (read_json if path.suffix == ".json" else read_yaml)(path)
                check(content)
                return content
        return None

    config = read_config(folder.config_file)
    if not folder.table_file.exists():
        raise ValueError("it has not begun: no progress.csv")
    table = read_table(folder.table_file)
    runtime = select(read(folder.hydra_file), "hydra", "runtime")
    start, sources = select(runtime, "cwd"), select(runtime, "config_sources") or ()
    # folders of --config-dir, and of config_dir in Python
    directories = [s["path"] for s in sources if s["provider"].endswith("command-line")]
    before = select(read(folder.composed_file), "frames")
    notes = {
        "overrides": read(folder.overrides_file),
        # relative to the folder where the run was started, as a user would type them
        "config_dirs": [os.path.relpath(p, start) if start else p for p in directories] or None,
        "frames_before": before if before != config.get("frames") else None,
        "certificate": read(folder.certificate_file, read_certificate),
        "code": read(folder.code_file, read_code),
        "evaluations": [
            {key: value for key, value in found.items() if key not in ("run", "checkpoint_file")}
            for path in folder.evaluation_files
            if (found := read(path, read_evaluation))
        ]
        or None,
    }
    kept = {name: value for name, value in notes.items() if value is not None}
    return Run(folder.directory, config, table, kept)


def archive_runs(runs: Iterable[Run], root: Path, archive: Path) -> None:
    """Add runs to an archive, or update them there; their names are their paths below ``root``.

    Raises:
        ValueError: If one folder lies in the other, the archive is none, or it has other runs or
            longer ones of these names.
        OSError: If it cannot be read or written.
    """
    here, there = root.resolve(), archive.resolve()
    if here.is_relative_to(there) or there.is_relative_to(here):
        raise ValueError(f"archive={archive}: it takes a folder beside {root}, not one within.")
    kept = read_archive(archive) if (archive / RUNS).exists() else {}
    names = {run.directory.resolve().relative_to(here).as_posix(): run for run in runs}
    for name in kept.keys() & names:
        differing = differences(kept[name].config, names[name].config)
        # what `resume=` may change makes no other run
        if found := [key for key in differing if not role_of(key).may_change]:
            raise ValueError(
                f"archive={archive}: its run {name} is another one than that in {root}: they "
                f"differ in {', '.join(found)}. Give another folder for these runs."
            )
        longest, steps = max(kept[name].table.get("steps", [0])), names[name].steps
        if longest > steps:
            raise ValueError(
                f"archive={archive}: its run {name} has {longest:,.0f} steps, that in {root} only "
                f"{steps:,}, which would replace them. Give another folder for these runs."
            )
    write_archive(kept | names, archive)


def write_archive(runs: Mapping[str, Run], folder: Path) -> None:
    """Write runs, by name, as an archive; equal runs give equal bytes."""
    pandas = import_extra("pandas", "report")
    runs = dict(sorted(runs.items()))
    folder.mkdir(parents=True, exist_ok=True)
    entries = {name: {"config": run.config, **run.notes} for name, run in runs.items()}
    lines = [f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in entries.items()]
    tables = {name: pandas.DataFrame(run.table) for name, run in runs.items()}
    rows = pandas.concat(tables, names=["run", "row"]).reset_index("run").convert_dtypes()
    table = rows.to_csv(index=False, lineterminator="\n")
    # the list last: a run that it names has its table, also if writing ends half-way
    texts = {ROWS: table, RUNS: "{" + ",\n".join(lines) + "}\n"}
    for name, text in texts.items():
        with replacing(folder / name) as unfinished:
            unfinished.write_bytes(gzip.compress(text.encode(), mtime=0))


def read_archive(folder: Path | str) -> dict[str, Run]:
    """Read the runs of an archive, by name, without checking them.

    Raises:
        ValueError: If the files are no archive.
    """
    folder = Path(folder)
    try:
        entries = json.loads(gzip.decompress((folder / RUNS).read_bytes()))
        tables = dict(_tables(folder / ROWS))
        return {
            name: Run(folder / name, notes.pop("config"), tables.get(name, {}), notes)
            for name, notes in entries.items()
        }
    except Exception as error:  # the files may hold anything
        raise ValueError(f"{folder.name} is no archive ({error})") from error


def _tables(path: Path) -> Iterator[tuple[str, dict[str, list[float]]]]:
    """The tables by run, each with the columns in which the run has a number."""
    pandas = import_extra("pandas", "report")
    kinds = defaultdict(lambda: "float", run="str")
    # only an empty field is no number: "NA" is the name of a run
    rows = pandas.read_csv(path, dtype=kinds, keep_default_na=False, na_values=[""])
    for name, table in rows.groupby("run", sort=False):
        own = table.drop(columns="run")
        known = own.columns[own.notna().any()]
        # before its first episode has ended, a run has no number in the first two
        kept = ["episode_return", *(f"episode_{c.removesuffix('_rate')}" for c in known), *known]
        yield name, own.loc[:, own.columns.isin(kept)].to_dict("list")
