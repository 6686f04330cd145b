"""The runs below a folder: configuration, table, command, videos, evaluations."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from safe_rl.runs.folder import RunFolder, runs_below
from safe_rl.runs.outcome import final_figures, judges_another_measure, violation
from safe_rl.runs.table import read_table

__all__ = ["Run", "find_runs", "read_run", "without_repetitions"]


@dataclass(frozen=True)
class Run:
    """One training run.

    Attributes:
        directory: Its folder.
        config: Its resolved configuration.
        table: Columns of its table; a row per epoch.
        frames: Environment steps after which it counts as finished.
    """

    directory: Path
    config: Mapping[str, Any]
    table: Mapping[str, list[float]]
    frames: int

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
        return {key: float(d) for key, d in self.config["cost_limits"].items()}

    @property
    def episode_length(self) -> int:
        """T_ep in steps."""
        return self.config["env"].get("num_steps", 1000)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.table["steps"][-1])

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
        return None if source is None else Path(str(source))

    @property
    def overrides(self) -> list[str] | None:
        """What its command line said, if Hydra has recorded it."""
        path = RunFolder(self.directory).overrides
        return [str(override) for override in OmegaConf.load(path)] if path.is_file() else None

    @property
    def command(self) -> str | None:
        """The command line that does it again, if Hydra has recorded it."""
        return (
            None if self.overrides is None else shlex.join(["python", "train.py", *self.overrides])
        )

    @property
    def videos(self) -> list[Path]:
        """Videos in its folder."""
        return sorted(self.directory.rglob("*.mp4"))

    def final(self, cost_keys: list[str]) -> dict[str, float]:
        """Final J_r, J_c and ρ_c by column name (section 5.1)."""
        return final_figures(self.table, cost_keys)

    def excess(self, key: str) -> float:
        """What the limit of a cost judges, minus d: a mean over the last five epochs."""
        return violation(self.final([key]), key, self.limits[key])

    def limits_another_measure(self, key: str) -> bool:
        """Whether the limit of a cost is on something else than the mean cost of an episode."""
        return judges_another_measure(self.table, key, self.limits[key])

    def evaluations(self) -> Iterator[dict[str, Any]]:
        """What :mod:`safe_rl.evaluate` has written into its folder."""
        for path in RunFolder(self.directory).evaluations():
            content = json.loads(path.read_text())
            if "estimates" in content:
                yield content


def find_runs(root: Path, *, unfinished: bool = False) -> tuple[list[Run], dict[Path, str]]:
    """Find every run below a folder, by its resolved configuration.

    Args:
        root: The folder.
        unfinished: Whether runs count as finished that have not come to their configured end.

    Returns:
        Runs that have finished an epoch, and folder -> why it was left out.

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
        outcome = read_run(folder.directory, unfinished=unfinished)
        if isinstance(outcome, Run):
            runs.append(outcome)
        else:
            skipped[folder.directory] = outcome
    if not runs:
        reasons = "".join(f"\n  {path}: {reason}" for path, reason in skipped.items())
        raise FileNotFoundError(
            f"There is no run to report below '{root}': a run is a folder with config.yaml and "
            f"progress.csv, as train.py writes it.{reasons}"
        )
    return runs, skipped


def read_run(directory: Path, *, unfinished: bool = False) -> Run | str:
    """A run, or why it cannot be read.

    Args:
        directory: Its folder, which holds a ``config.yaml``.
        unfinished: Whether it counts as finished before its configured end.
    """
    folder = RunFolder(directory)
    try:
        config = OmegaConf.to_container(OmegaConf.load(folder.config), resolve=True)
    except (YAMLError, OmegaConfBaseException, UnicodeDecodeError) as error:
        return f"config.yaml cannot be read ({str(error).splitlines()[0]})"
    needed = {"env", "algo", "seed", "cost_limits", "frames"}
    if not isinstance(config, dict) or not needed <= set(config):
        return "config.yaml is not that of a run"
    if not folder.has_begun:
        return "it has not begun: no progress.csv"
    try:
        table = read_table(folder.table)
    except ValueError as error:
        return f"progress.csv cannot be read ({error})"
    if not table.get("steps"):
        return "it has not finished an epoch"
    return Run(directory, config, table, 0 if unfinished else config["frames"])  # type: ignore[arg-type]


def without_repetitions(runs: list[Run]) -> tuple[list[Run], dict[Path, str]]:
    """Keep one of several runs with the same configuration and seed.

    The same seed twice is one sample, not two. The one that has come further is kept, among equals
    the newer.

    Args:
        runs: Runs of one experiment, alike in all but the seed.

    Returns:
        Runs by ascending seed, and folder -> why it was left out.
    """
    kept: dict[int, Run] = {}
    skipped: dict[Path, str] = {}
    for run in sorted(runs, key=lambda run: (run.steps, _modified(run))):
        if run.seed in kept:
            skipped[kept[run.seed].directory] = (
                f"{run.directory} is the same run with the same seed"
            )
        kept[run.seed] = run
    return [kept[seed] for seed in sorted(kept)], skipped


def _modified(run: Run) -> float:
    path = RunFolder(run.directory).table
    return path.stat().st_mtime if path.exists() else math.nan
