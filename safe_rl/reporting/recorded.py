"""Runs as their folders record them, whoever wrote these: configuration, table, command, films.

Whatever is odd in a folder becomes a sentence on why it, or a file of it, is left out. Nothing is
read that a link in the folder names outside of it, and nothing that a file says is followed.
"""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safe_rl.reporting.cleaning import clean
from safe_rl.reporting.measured import read_certificate, read_code, read_evaluation
from safe_rl.runs.files import read_config, read_yaml
from safe_rl.runs.folder import RunFolder, paths_below, runs_below
from safe_rl.runs.outcome import final_figures, judges_another_measure, violation
from safe_rl.runs.table import read_table

__all__ = ["Run", "find_runs"]

# a number that has left all bounds says as little as NaN, and fits no picture
_EXPLODED = 1e30


@dataclass(frozen=True)
class Run:
    """One training run.

    Attributes:
        directory: Its folder.
        config: Its configuration.
        table: Columns of its table; a row per epoch, NaN where there is no number.
        frames: Environment steps after which it counts as finished.
        command: The command line that does it again, if Hydra has recorded it.
        overrides: What its command line said.
        cwd: Where it was started, if Hydra has recorded it.
        evaluations: What ``safe_rl.evaluate`` has written into its folder.
        certificate: Which of its checkpoints is certified, or by how much none is.
        code: By which version and commit it was carried out, in words, if that is recorded.
        videos: Videos in its folder.
    """

    directory: Path
    config: Mapping[str, Any]
    table: Mapping[str, list[float]]
    frames: int
    overrides: tuple[str, ...] | None = None
    command: str | None = None
    cwd: Path | None = None
    evaluations: tuple[Mapping[str, Any], ...] = ()
    certificate: Mapping[str, Any] | None = None
    code: str | None = None
    videos: tuple[Path, ...] = ()

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
        """Environment steps that it was meant to take; of an unfinished run, those it has taken.

        A run ends with a whole batch, some steps later, which is no longer training than that of
        another one with smaller batches.
        """
        meant = self.config["frames"]
        return int(meant) if 0 < meant <= self.steps else self.steps

    @property
    def is_finished(self) -> bool:
        """Whether it has come to its end."""
        return self.steps >= self.frames

    @property
    def hours(self) -> float:
        """Time of training so far [h]."""
        return self.table["time_total"][-1] / 3600

    @property
    def init_from(self) -> Path | None:
        """The run or checkpoint whose networks it started from, as its command line named it."""
        source = self.config.get("init_from")
        return None if source is None else Path(source)

    def column(self, name: str) -> np.ndarray:
        """A column in the epochs in which an episode finished, shape [epochs]; NaN without one."""
        known = np.isfinite(self.table["episode_return"])
        return np.array(self.table.get(name, np.full(known.shape, math.nan)), dtype=float)[known]

    def final(self, cost_keys: Sequence[str]) -> dict[str, float]:
        """Final J_r, J_c and ρ_c by column name (section 5.1), of the costs that it has."""
        own = [key for key in cost_keys if f"{key}_rate" in self.table]
        return final_figures(self.table, own)

    def excess(self, key: str) -> float:
        """What the limit of a cost judges, minus d: a mean over the last epochs."""
        return violation(self.final([key]), key, self.limits[key])

    def limits_another_measure(self, key: str) -> bool:
        """Whether the limit of a cost is on something else than the mean cost of an episode."""
        return judges_another_measure(self.table, key, self.limits[key])


def find_runs(root: Path, *, unfinished: bool = False) -> tuple[list[Run], dict[Path, str]]:
    """Find every run below a folder.

    Args:
        root: The folder.
        unfinished: Whether runs count as finished that have not come to their configured end.

    Returns:
        Runs that have finished an epoch, and folder or file -> why it was left out.

    Raises:
        FileNotFoundError: If there is no such folder, or no run in it.
    """
    if not root.is_dir():
        raise FileNotFoundError(
            f"There is no folder '{root}': give the folder that holds the runs."
        )
    runs: list[Run] = []
    skipped: dict[Path, str] = {}
    for folder in runs_below(root):
        try:
            runs.append(_read_run(folder, root.resolve(), unfinished, skipped))
        except Exception as error:  # whatever is wrong with it, the others are reported
            skipped[folder.directory] = clean(error) or type(error).__name__
    if not runs:
        reasons = "".join(f"\n  {clean(path)}: {reason}" for path, reason in skipped.items())
        raise FileNotFoundError(
            f"There is no run to report below '{root}': a run is a folder with config.yaml and "
            f"progress.csv, as train.py writes it.{reasons}"
        )
    return runs, skipped


def _read_run(folder: RunFolder, root: Path, unfinished: bool, skipped: dict[Path, str]) -> Run:
    config = read_config(_own(folder.config, root))
    for key, is_right, wanted in _NEEDED:
        if not is_right(config.get(key)):
            raise ValueError(f"config.yaml is not that of a run: its '{key}' is not {wanted}")
    recorded = folder.recorded_table
    if not recorded.is_file():
        raise ValueError("it has not begun: no progress.csv")
    table = _read_numbers(_own(recorded, root), config["cost_limits"] or {})

    def read(paths: Iterable[Path], reader: Callable[[Path], Any]) -> list[Any]:
        """What files of the run hold; those that cannot be read are noted."""
        contents = []
        for path in paths:
            try:
                contents.append(reader(_own(path, root)))
            except Exception as error:
                skipped[path] = clean(error) or type(error).__name__
        return contents

    def there(path: Path) -> list[Path]:
        return [path] if os.path.lexists(path) else []

    notes = (folder.surroundings, folder.overrides, folder.composed)
    hydra, said, begun_with = (next(iter(read(there(n), read_yaml)), None) for n in notes)
    overrides = tuple(map(clean, said)) if isinstance(said, list) else None
    cwd = _select(hydra, "hydra", "runtime", "cwd")
    return Run(
        folder.directory,
        config,
        table,
        frames=0 if unfinished else config["frames"],
        overrides=overrides,
        command=None if overrides is None else _command(overrides, hydra, begun_with, config),
        cwd=Path(cwd) if isinstance(cwd, str) else None,
        evaluations=tuple(filter(None, read(folder.evaluations(), read_evaluation))),
        certificate=next(iter(read(there(folder.certificate), read_certificate)), None),
        code=next(iter(read(there(folder.code), read_code)), None),
        videos=tuple(read(_films(folder), lambda path: path)),
    )


def _films(run: RunFolder) -> list[Path]:
    """Videos in a run's folder: neither those of runs below it, nor what a killed one has left."""

    def is_own(path: Path) -> bool:
        nearest = next(folder for folder in path.parents if RunFolder(folder).is_run)
        return nearest == run.directory and not path.name.startswith(".")

    return list(filter(is_own, paths_below(run.directory, "*.mp4")))


def _own(path: Path, root: Path) -> Path:
    if not path.resolve().is_relative_to(root):
        raise ValueError(f"{path.name} is a link to outside of the folder")
    if not path.is_file():
        raise ValueError(f"{path.name} is no file")
    return path


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_named(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("name"), str) and bool(value["name"])


def _are_limits(value: Any) -> bool:
    return value is None or (isinstance(value, dict) and all(map(_is_number, value.values())))


_NEEDED: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("env", lambda v: isinstance(v, dict), "a mapping"),
    ("algo", _is_named, "a mapping with a name"),
    ("seed", lambda v: isinstance(v, int) and not isinstance(v, bool), "a whole number"),
    ("frames", lambda v: _is_number(v) and v >= 0, "a number of steps"),
    ("cost_limits", _are_limits, "a mapping of costs to numbers"),
    ("init_from", lambda v: v is None or isinstance(v, str), "a path"),
)


def _read_numbers(path: Path, limits: Mapping[str, Any]) -> dict[str, list[float]]:
    try:
        table = read_table(path)
    except ValueError as error:
        raise ValueError(f"progress.csv cannot be read ({error})") from error
    if not table.get("steps"):
        raise ValueError("it has not finished an epoch")
    needed = ["episode_return", "time_total"]
    needed += [name for key in limits for name in (f"episode_{key}", f"{key}_rate")]
    missing = [name for name in needed if name not in table]
    if missing:
        raise ValueError(f"progress.csv has no column {missing[0]}")
    bounded = {
        name: [value if abs(value) < _EXPLODED else math.nan for value in values]
        for name, values in table.items()
    }
    steps, seconds = bounded["steps"], bounded["time_total"][-1]
    if not (steps[0] > 0 and all(np.diff(steps) > 0) and seconds > 0):
        raise ValueError("progress.csv cannot be read (its steps or times do not grow)")
    return bounded


def _command(
    overrides: Sequence[str], hydra: Any, begun_with: Any, config: Mapping[str, Any]
) -> str:
    """The command line, with what it did not say in its overrides."""
    words = ["python", "train.py"]
    for source in _select(hydra, "hydra", "runtime", "config_sources") or ():
        # of --config-dir, and of Python's config_dir
        if str(_select(source, "provider")).endswith("command-line"):
            words.append(f"--config-dir={clean(_select(source, 'path'))}")
    frames = config["frames"]
    # a run that was continued for longer
    if isinstance(before := _select(begun_with, "frames"), int) and before != frames:
        overrides = [o for o in overrides if not o.startswith("frames=")] + [f"frames={frames}"]
    return shlex.join([*words, *overrides])


def _select(node: Any, *keys: str) -> Any:
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node
