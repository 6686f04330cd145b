"""Runs as a report reads them: in folders of their own and in archives; archives are written here.

An archive has two files. ``runs.json.gz`` has a line per run, with its configuration and notes.
``rows.csv.gz`` has the epochs of all runs, with the run in the first column. Files that cannot be
read are left out, with a reason.
"""

from __future__ import annotations

import gzip
import io
import json
import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from safe_rl.extras import import_extra
from safe_rl.files import read_bounded, read_config, read_json, read_yaml, replacing
from safe_rl.reporting.tables import clean, read_certificate, read_code, read_evaluation
from safe_rl.runs import run as folders
from safe_rl.runs.folder import paths_below
from safe_rl.runs.identity import (
    RESUMABLE,
    changed_settings,
    config_dirs,
    differences,
    repeating,
    unusable_keys,
)
from safe_rl.runs.table import read_table

RUNS, ROWS = "runs.json.gz", "rows.csv.gz"
_MOST_BYTES = 200_000_000  # of either file when it is unpacked


class ReportedRun(folders.Run):
    """A run of a report; ``notes`` are ``overrides``, ``certificate`` … as in its files.

    Attributes:
        source: Name of the baselines that it belongs to; "" for a run of the report itself.
    """

    notes: Mapping[str, Any]
    source: str = ""

    @cached_property
    def overrides(self) -> list[str] | None:
        """Overrides of its command line, or None if they are not recorded."""
        given = self.notes.get("overrides")
        return [clean(word, 10_000) for word in given] if isinstance(given, list) else None

    def check(self) -> None:
        """Refuse a run that lacks what a report needs.

        Raises:
            ValueError: If the configuration or the table lacks something.
            Exception: Of any type, if notes are not as a run writes them.
        """
        limits = self.settings.get("cost_limits") or {}
        if wrong := unusable_keys({"frames": None, **self.settings, "cost_limits": limits}):
            raise ValueError(
                f"config.yaml is not that of a run: it lacks a usable {', '.join(wrong)}"
            )
        if not self.table.get("steps"):
            raise ValueError("it has not finished an epoch")
        needed = ["episode_return", "time_total"]
        needed += [name for key in self.cost_limits for name in (f"episode_{key}", f"{key}_rate")]
        if missing := [name for name in needed if name not in self.table]:
            raise ValueError(f"progress.csv has no column {missing[0]}")
        steps = np.array([0.0, *self.table["steps"]])
        if not (np.isfinite(steps).all() and (np.diff(steps) > 0).all() and self.hours > 0):
            raise ValueError("progress.csv cannot be read (its steps or times do not grow)")
        # of these, tables are made later
        _ = self.repeating
        for evaluation in self.notes.get("evaluations", ()):
            read_evaluation(evaluation)
        if "certificate" in self.notes:
            read_certificate(self.notes["certificate"])
        if "code" in self.notes:
            read_code(self.notes["code"])

    @property
    def length(self) -> int:
        """The configured number of environment steps; for an unfinished run, those so far."""
        return min(int(self.settings["frames"]) or self.steps, self.steps)

    @property
    def repeating(self) -> str | None:
        """The command that repeats it, or None if its overrides are not recorded."""
        if self.overrides is None:
            return None
        folders, changed = map(clean, self.notes.get("config_dirs", ())), self.notes.get("changed")
        return repeating(self.overrides, folders, {clean(k): v for k, v in (changed or {}).items()})


def read_runs(root: Path, *, unfinished: bool = False) -> tuple[list[ReportedRun], dict[Path, str]]:
    """Runs below a folder that have finished an epoch, also of archives; and what is left out.

    The latter is folder or file -> reason. With ``unfinished`` all runs count as finished.

    Raises:
        FileNotFoundError: If there is no such folder, or no run in it.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"There is no folder '{root}': give the folder of the runs.")
    candidates: list[ReportedRun] = []
    skipped: dict[Path, str] = {}
    for path in paths_below(root, RUNS):
        with _noted(path, skipped):
            candidates += read_archive(path.parent).values()
    skipped |= dict.fromkeys(_links(root), "it is a link to a folder, which is not followed")
    for folder in folders.find_runs(root):
        with _noted(folder.directory, skipped):
            candidates.append(_read_run(folder, skipped))
    runs = []
    for run in candidates:
        with _noted(run.directory, skipped):
            run.check()
            run.is_finished = run.is_finished or unfinished
            runs.append(run)
    if not runs:
        reasons = "".join(f"\n  {clean(path)}: {reason}" for path, reason in skipped.items())
        raise FileNotFoundError(
            f"There is no run to report below '{root}': a run is a folder with config.yaml and "
            f"progress.csv, as train.py writes it.{reasons}"
        )
    return sorted(runs, key=lambda run: run.directory), skipped


def _links(root: Path) -> Iterator[Path]:
    """Links to folders below a folder, but for those of Weights & Biases."""
    for folder, names, _ in os.walk(root):
        if Path(folder).name != "wandb":
            yield from (path for name in names if (path := Path(folder, name)).is_symlink())


@contextmanager
def _noted(path: Path, skipped: dict[Path, str]) -> Iterator[None]:
    """Note the error of the block as the reason why a folder or file is left out."""
    try:
        yield
    except Exception as error:  # files of unknown origin may hold anything
        is_told = isinstance(error, ValueError | OSError)
        reason = error if is_told else f"{path.name} is not as a run writes it ({error!r})"
        skipped[path] = clean(reason)


def _read_run(folder: folders.Run, skipped: dict[Path, str]) -> ReportedRun:
    """Read a run from its folder; notes that cannot be read are left out."""

    def read(path: Path, check: Callable[[Any], object] = bool) -> Any:
        """The content of a file; None if there is no file, or it fails the check."""
        with _noted(path, skipped):
            if path.exists():
                content = (read_json if path.suffix == ".json" else read_yaml)(path)
                check(content)
                return content
        return None

    settings = read_config(folder.config_file)
    if not folder.table_file.exists():
        raise ValueError("no progress.csv: it is no run of safe_rl, or has not begun")
    table = read_table(folder.table_file)
    with _noted(folder.table_file, skipped):
        if not read_bounded(folder.table_file, _MOST_BYTES).endswith(b"\n"):
            raise ValueError("its last line does not end with a line break, and is not read")
    notes = {
        "overrides": read(folder.overrides_file),
        "config_dirs": config_dirs(read(folder.hydra_file)) or None,
        "changed": changed_settings(read(folder.composed_file), settings) or None,
        "certificate": read(folder.certificate_file, read_certificate),
        "code": read(folder.code_file, read_code),
        "evaluations": [
            {k: v for k, v in evaluation.items() if k not in ("run", "checkpoint_file")}
            for path in folder.evaluation_files
            if (evaluation := read(path, read_evaluation))
        ]
        or None,
    }
    kept = {name: value for name, value in notes.items() if value is not None}
    return ReportedRun(folder.directory, settings=settings, table=table, notes=kept)


def archive_runs(runs: Iterable[ReportedRun], root: Path, archive: Path) -> None:
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
        # what `resume=` may change makes no other run
        if changed := differences(kept[name].settings, names[name].settings, RESUMABLE):
            raise ValueError(
                f"archive={archive}: its run {name} is another one than that in {root}: they "
                f"differ in {', '.join(changed)}. Give another folder for these runs."
            )
        longest, steps = max(kept[name].table.get("steps", [0])), names[name].steps
        if longest > steps:
            raise ValueError(
                f"archive={archive}: its run {name} has {longest:,.0f} steps, that in {root} only "
                f"{steps:,}, which would replace them. Give another folder for these runs."
            )
    _write_archive(dict(sorted((kept | names).items())), archive)


def _write_archive(runs: Mapping[str, ReportedRun], folder: Path) -> None:
    """Write runs, by name, as an archive; equal runs give equal bytes."""
    pandas = import_extra("pandas", "report")
    folder.mkdir(parents=True, exist_ok=True)
    lines = [
        f"{json.dumps(name)}: {json.dumps({'config': run.settings, **run.notes})}"
        for name, run in runs.items()
    ]
    tables = {name: pandas.DataFrame(run.table) for name, run in runs.items()}
    rows = pandas.concat(tables, names=["run", "row"]).reset_index("run").convert_dtypes()
    table = rows.to_csv(index=False, lineterminator="\n")
    # the list last: a run that it names has its table, also if writing ends half-way
    texts = {ROWS: table, RUNS: "{" + ",\n".join(lines) + "}\n"}
    for name, text in texts.items():
        with replacing(folder / name) as unfinished:
            unfinished.write_bytes(gzip.compress(text.encode(), mtime=0))


def read_archive(folder: Path | str) -> dict[str, ReportedRun]:
    """Read the runs of an archive, by name, without checking them.

    Raises:
        ValueError: If the files are no archive.
    """
    folder = Path(folder)
    try:
        entries = json.loads(read_bounded(folder / RUNS, _MOST_BYTES, packed=True))
        tables = dict(_tables(folder / ROWS))
        runs = {}
        for name, notes in entries.items():
            contents = {"settings": notes.pop("config"), "table": tables.get(name, {})}
            runs[name] = ReportedRun(folder / name, **contents, notes=notes)
        return runs
    except Exception as error:  # the files may hold anything
        raise ValueError(f"{folder.name} is no archive ({error})") from error


def _tables(path: Path) -> Iterator[tuple[str, dict[str, list[float]]]]:
    """The tables by run, each with the columns in which the run has a number."""
    pandas = import_extra("pandas", "report")
    kinds = defaultdict(lambda: "float", run="str")
    # only an empty field is no number: "NA" is the name of a run
    text = io.BytesIO(read_bounded(path, _MOST_BYTES, packed=True))
    rows = pandas.read_csv(text, dtype=kinds, keep_default_na=False, na_values=[""])
    for name, table in rows.groupby("run", sort=False):
        frame = table.drop(columns="run")
        known = frame.columns[frame.notna().any()]
        # before its first episode has ended, a run has no number in the first two
        kept = ["episode_return", *(f"episode_{c.removesuffix('_rate')}" for c in known), *known]
        yield name, frame.loc[:, frame.columns.isin(kept)].to_dict("list")
