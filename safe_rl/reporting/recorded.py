"""Runs as their folders and archives record them; what cannot be read is left out with a reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safe_rl.files import read_config, read_json, read_yaml
from safe_rl.reporting import archive as archives
from safe_rl.reporting.archive import (
    Recorded,
    command_of,
    read_certificate,
    read_code,
    read_evaluation,
    select,
)
from safe_rl.reporting.tables import clean
from safe_rl.runs.folder import RunFolder, paths_below, runs_below
from safe_rl.runs.outcome import final_figures, judges_another_measure, violation
from safe_rl.runs.table import read_table

__all__ = ["Run", "archive_runs", "find_runs"]


@dataclass(frozen=True)
class Run:
    """One training run.

    Attributes:
        directory: Its folder; of an archived run the folder that it would have in the archive.
        config: Its configuration.
        table: Columns of its table; a row per epoch, NaN where there is no number.
        frames: Environment steps after which it counts as finished.
        overrides: What its command line said.
        command: The command line that does it again, if Hydra has recorded it.
        evaluations: What ``safe_rl.evaluate`` has found, a record each, see `read_evaluation`.
        certificate: Which of its checkpoints is certified, see `read_certificate`.
        code: By which version and commit it was carried out, in words, if that is recorded.
        recorded: What all of this was made of.
    """

    directory: Path
    config: Mapping[str, Any]
    table: Mapping[str, list[float]]
    frames: int
    overrides: tuple[str, ...] | None = None
    command: str | None = None
    evaluations: tuple[Mapping[str, Any], ...] = ()
    certificate: Mapping[str, Any] | None = None
    code: str | None = None
    recorded: Recorded | None = None

    @property
    def seed(self) -> int:
        """Seed of networks, layouts and actions."""
        return self.config["seed"]

    @property
    def algorithm(self) -> str:
        """Name of the file in ``conf/algo``."""
        return self.config["algo"]["name"]

    @property
    def limits(self) -> dict[str, float]:
        """Cost key -> d, undiscounted cost per episode."""
        return {key: float(d) for key, d in (self.config["cost_limits"] or {}).items()}

    @property
    def episode_length(self) -> int | None:
        """T_ep in steps, if the configuration says it."""
        found = (self.config["env"].get(key) for key in ("num_steps", "max_episode_steps"))
        return next((n for n in found if isinstance(n, int) and n > 0), None)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.table["steps"][-1])

    @property
    def length(self) -> int:
        """Environment steps that were configured; of an unfinished run, those it has taken."""
        configured = self.config["frames"]
        return int(configured) if 0 < configured <= self.steps else self.steps

    @property
    def is_finished(self) -> bool:
        """Whether it is finished."""
        return self.steps >= self.frames

    @property
    def state(self) -> str:
        """How far it has come to its own end, whether or not it counts as finished."""
        whole = self.config["frames"]
        return "finished" if self.steps >= whole else f"{self.steps / whole:.0%}"

    @property
    def hours(self) -> float:
        """Time of training so far [h]."""
        return self.table["time_total"][-1] / 3600

    def column(self, name: str) -> np.ndarray:
        """A column in the epochs in which an episode finished, shape [epochs]; NaN without one."""
        known = np.isfinite(self.table["episode_return"])
        return np.array(self.table.get(name, [math.nan] * known.size), dtype=float)[known]

    def final(self, cost_keys: Sequence[str]) -> dict[str, float]:
        """Final J_r, J_c and ρ_c by column name (section 5.1), of the costs that it has."""
        return final_figures(self.table, [key for key in cost_keys if f"{key}_rate" in self.table])

    def excess(self, key: str) -> float:
        """What the limit of a cost judges, minus d: a mean over the last epochs."""
        return violation(self.final([key]), key, self.limits[key])

    def limits_another_measure(self, key: str) -> bool:
        """Whether the limit of a cost is on something else than the mean cost of an episode."""
        return judges_another_measure(self.table, key, self.limits[key])


def find_runs(root: Path, *, unfinished: bool = False) -> tuple[list[Run], dict[Path, str]]:
    """Find every run below a folder, in folders of their own and in archives.

    Args:
        root: The folder.
        unfinished: Whether runs count as finished that have not come to their configured end.

    Returns:
        Runs that have finished an epoch, and folder or file -> why it was left out.

    Raises:
        FileNotFoundError: If there is no such folder, or no run in it.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"There is no folder '{root}': give the folder of the runs.")
    runs: list[Run] = []
    skipped: dict[Path, str] = {}
    for archive in paths_below(root, archives.RUNS):
        with _noted(archive, skipped):
            for name, recorded in archives.read_archive(archive.parent).items():
                directory = archive.parent / name
                with _noted(directory, skipped):
                    runs.append(_run(directory, recorded, unfinished))
    for folder in runs_below(root):
        with _noted(folder.directory, skipped):
            runs.append(_run(folder.directory, _recorded(folder, skipped), unfinished))
    if not runs:
        reasons = "".join(f"\n  {clean(path)}: {reason}" for path, reason in skipped.items())
        raise FileNotFoundError(
            f"There is no run to report below '{root}': a run is a folder with config.yaml and "
            f"progress.csv, as train.py writes it.{reasons}"
        )
    return sorted(runs, key=lambda run: run.directory), skipped


def archive_runs(runs: Iterable[Run], root: Path, archive: Path) -> None:
    """Add runs to an archive, or bring them up to date in it, each by its path below ``root``.

    Raises:
        ValueError: If the archive is among the runs or they in it, or is no archive.
        OSError: If it cannot be read or written.
    """
    here, there = root.resolve(), archive.resolve()
    if here.is_relative_to(there) or there.is_relative_to(here):
        raise ValueError(f"archive={archive}: it takes a folder beside {root}, not one within.")
    kept = archives.read_archive(archive) if (archive / archives.RUNS).exists() else {}
    for run in runs:
        if run.recorded is not None:
            name = run.directory.resolve().relative_to(here).as_posix()
            kept[name] = run.recorded._replace(notes=archives.without_places(run.recorded.notes))
    archives.write_archive(kept, archive)


@contextmanager
def _noted(path: Path, skipped: dict[Path, str]) -> Iterator[None]:
    """Note why something is left out; everything else is reported."""
    try:
        yield
    except (ValueError, OSError) as error:
        skipped[path] = clean(error)
    except Exception as error:  # files of anybody may hold anything
        skipped[path] = clean(f"{path.name} is not as a run writes it ({error!r})")


def _recorded(folder: RunFolder, skipped: dict[Path, str]) -> Recorded:
    """What a run's folder holds; notes that cannot be read are left out."""

    def read(path: Path, check: Callable[[Any], object] = bool) -> Any:
        """What a file holds that passes a check; None of any other."""
        with _noted(path, skipped):
            if path.exists():
                content = (read_json if path.suffix == ".json" else read_yaml)(path)
                check(content)
                return content
        return None

    config = read_config(folder.config)
    if not folder.table.exists():
        raise ValueError("it has not begun: no progress.csv")
    table = read_table(folder.table)
    runtime = select(read(folder.surroundings), "hydra", "runtime")
    before = select(read(folder.composed), "frames")
    notes = {
        "overrides": read(folder.overrides),
        "cwd": select(runtime, "cwd"),
        # of --config-dir, and of Python's config_dir
        "config_dirs": [
            str(select(source, "path"))
            for source in select(runtime, "config_sources") or ()
            if str(select(source, "provider")).endswith("command-line")
        ],
        "frames_before": before if before != config.get("frames") else None,
        "certificate": read(folder.certificate, read_certificate),
        "code": read(folder.code, read_code),
        "evaluations": [
            found for path in folder.evaluations() if (found := read(path, read_evaluation))
        ],
    }
    return Recorded(config, table, {name: value for name, value in notes.items() if value})


def _run(directory: Path, recorded: Recorded, unfinished: bool) -> Run:
    config, table, notes = recorded
    _check(config)
    _check_table(table, config.get("cost_limits") or {})
    said = notes.get("overrides")
    overrides = tuple(map(clean, said)) if isinstance(said, list) else None
    return Run(
        directory,
        config,
        table,
        frames=0 if unfinished else config["frames"],
        overrides=overrides,
        command=None if overrides is None else command_of(overrides, notes, config),
        evaluations=tuple(map(read_evaluation, notes.get("evaluations", ()))),
        certificate=read_certificate(notes["certificate"]) if "certificate" in notes else None,
        code=read_code(notes["code"]) if "code" in notes else None,
        recorded=recorded,
    )


def _check(config: Mapping[str, Any]) -> None:
    """Refuse a configuration without what every run has."""
    frames, limits = config.get("frames", -1), config.get("cost_limits") or {}
    source = config.get("init_from")
    are_right = {
        "env": isinstance(config.get("env"), dict),
        "algo": bool(name := select(config.get("algo"), "name")) and isinstance(name, str),
        "seed": type(config.get("seed")) is int,
        "frames": _is_number(frames) and frames >= 0,
        "cost_limits": isinstance(limits, dict) and all(map(_is_number, limits.values())),
        "init_from": source is None or isinstance(source, str),
    }
    if wrong := [key for key, is_right in are_right.items() if not is_right]:
        keys = ", ".join(wrong)
        raise ValueError(f"config.yaml is not that of a run: it lacks a usable {keys}")


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _check_table(table: Mapping[str, list[float]], limits: Mapping[str, Any]) -> None:
    """Refuse a table without the columns and the growing steps that a report needs."""
    if not table.get("steps"):
        raise ValueError("it has not finished an epoch")
    needed = ["episode_return", "time_total"]
    needed += [name for key in limits for name in (f"episode_{key}", f"{key}_rate")]
    if missing := [name for name in needed if name not in table]:
        raise ValueError(f"progress.csv has no column {missing[0]}")
    steps, seconds = table["steps"], table["time_total"][-1]
    if not (0 < steps[0] <= steps[-1] < math.inf and all(np.diff(steps) > 0) and seconds > 0):
        raise ValueError("progress.csv cannot be read (its steps or times do not grow)")
