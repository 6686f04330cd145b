"""Experiments: runs that differ in nothing but the seed, and names to tell them apart by."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safe_rl.reporting.runs import Run, without_repetitions
from safe_rl.runs.folder import common_source
from safe_rl.scores.published import ALGORITHMS, COST_LIMIT, REFERENCE, Scores

__all__ = [
    "MANNER",
    "Experiment",
    "distinguishing_keys",
    "environment_names",
    "flatten",
    "group_runs",
]

Settings = dict[str, Hashable]

MANNER = {
    "seed", "device", "num_threads", "compile", "checkpoint", "logger", "default_cost_limits",
    "hydra", "resume", "collector", "num_collectors", "import",
}  # fmt: skip
"""Settings of how a run is carried out, not of what it measures."""


@dataclass(frozen=True)
class Experiment:
    """One algorithm on one environment.

    Attributes:
        environment: Name of the environment, with what was changed of it.
        algorithm: Name of the algorithm, with what tells it from others of that name.
        benchmark: Name in the suite if the environment is exactly that one, else None.
        runs: One per seed.
    """

    environment: str
    algorithm: str
    benchmark: str | None
    runs: tuple[Run, ...]

    @property
    def reference(self) -> Scores | None:
        """Characteristic metrics to normalise by, if the environment has them."""
        return None if self.benchmark is None else REFERENCE.get(self.benchmark)

    @property
    def limits(self) -> dict[str, float]:
        """Cost key -> d, undiscounted cost per episode."""
        return self.runs[0].limits

    @property
    def has_published_limit(self) -> bool:
        """Whether it has the limit, and only that, with which results were published."""
        return self.limits == {"cost": COST_LIMIT} and not self.limits_of_other_measures

    @property
    def limits_of_other_measures(self) -> list[str]:
        """Cost keys whose limit is on something else than the mean cost of an episode."""
        return [k for k in self.limits if any(run.limits_another_measure(k) for run in self.runs)]

    @property
    def is_continued(self) -> bool:
        """Whether a run of it started from another run's networks."""
        return any(run.init_from is not None for run in self.runs)

    @property
    def finished(self) -> tuple[Run, ...]:
        """Runs that have come to their configured end."""
        return tuple(run for run in self.runs if run.is_finished)


def flatten(settings: Mapping[str, Any], prefix: str = "") -> Settings:
    """Nested settings as one mapping with dotted keys; lists become tuples.

    Examples:
        >>> flatten({"model": {"hidden_sizes": [64, 64]}, "seed": 1})
        {'model.hidden_sizes': (64, 64), 'seed': 1}
    """
    flat: Settings = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = _hashable(value)
    return flat


def _hashable(value: Any) -> Hashable:
    return tuple(map(_hashable, value)) if isinstance(value, list | tuple) else value


def distinguishing_keys(cells: Iterable[Sequence[Settings]]) -> list[str]:
    """Keys that differ within a cell, but for those that follow from another one.

    What follows from ``preset``, or from the ``_target_`` of the group that a key belongs to, is
    not named: it is told by these.

    Args:
        cells: Groups of settings that have to be told apart within the group, not across groups.

    Examples:
        >>> small, large = {"preset": "a", "model.width": 1}, {"preset": "b", "model.width": 2}
        >>> distinguishing_keys([[small, large, small]])
        ['preset']
    """
    cells = [list(cell) for cell in cells]
    keys = sorted(
        {key for cell in cells for settings in cell for key in settings},
        key=lambda key: (key != "preset", key.count("."), key),
    )
    return [key for key in keys if any(not _follows(key, cell) for cell in cells)]


def _follows(key: str, cell: Sequence[Settings]) -> bool:
    """Whether a key's value is settled by those of the keys that stand for it."""
    names = key.split(".")
    groups = [".".join([*names[:depth], "_target_"]) for depth in range(1, len(names))]
    above = [other for other in ("preset", *groups) if other != key]
    values: dict[tuple[Hashable, ...], set[Hashable]] = defaultdict(set)
    for settings in cell:
        values[tuple(settings.get(other) for other in above)].add(settings.get(key))
    return all(len(found) == 1 for found in values.values())


def group_runs(
    runs: Sequence[Run], suite: Mapping[str, Mapping[str, Any]]
) -> tuple[list[Experiment], dict[Path, str]]:
    """Group runs into experiments.

    Args:
        runs: Runs of any environments and algorithms.
        suite: Name -> every key of a benchmark environment.

    Returns:
        Experiments in the order of the benchmark and of the paper's tables, and folder -> why a
        run was left out.
    """
    environments = environment_names(runs, suite)
    algorithms = _algorithm_names(runs, environments)
    cells: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs:
        cells[environments[run.directory], algorithms[run.directory]].append(run)
    skipped: dict[Path, str] = {}
    experiments = []
    for (environment, algorithm), members in cells.items():
        kept, left_out = without_repetitions(members)
        skipped |= left_out
        benchmark = environment if environment in suite else None
        experiments.append(Experiment(environment, algorithm, benchmark, tuple(kept)))
    return sorted(experiments, key=_order), skipped


def _order(experiment: Experiment) -> tuple[Hashable, ...]:
    """Benchmark environments first, algorithms as in the paper, variants behind each other."""
    benchmarks, names = list(REFERENCE), list(ALGORITHMS)
    name = experiment.runs[0].algorithm
    return (
        benchmarks.index(experiment.environment) if experiment.benchmark in benchmarks else 99,
        experiment.environment,
        names.index(name) if name in names else 99,
        experiment.algorithm,
    )


def environment_names(
    runs: Sequence[Run], suite: Mapping[str, Mapping[str, Any]]
) -> dict[Path, str]:
    """Folder -> name of the environment, with the keys that differ from the suite's.

    Args:
        runs: Of an environment that is not in the suite, the first one's settings are the measure.
        suite: Name -> every key of a benchmark environment.
    """
    names: dict[Path, str] = {}
    standards = {name: flatten(node) for name, node in suite.items()}
    for run in runs:
        settings = flatten(run.config["env"])
        name = str(settings.pop("name", "environment"))
        standard = standards.setdefault(name, settings)
        changed = {
            key: value
            for key, value in settings.items()
            if key not in standard or value != standard[key]
        }
        names[run.directory] = name + _in_brackets(changed)
    return names


def _algorithm_names(runs: Sequence[Run], environments: Mapping[Path, str]) -> dict[Path, str]:
    """Folder -> name of the algorithm, with the settings that tell it from its namesakes."""
    settings = {run.directory: _learning_settings(run) for run in runs}
    names = {}
    for algorithm in {run.algorithm for run in runs}:
        members = [run for run in runs if run.algorithm == algorithm]
        cells: dict[str, list[Settings]] = defaultdict(list)
        for run in members:
            cells[environments[run.directory]].append(settings[run.directory])
        # an experiment may train longer on one environment than on another
        anywhere = [
            {key: value for key, value in settings[run.directory].items() if key != "frames"}
            for run in members
        ]
        keys = distinguishing_keys([*cells.values(), anywhere])
        title = ALGORITHMS.get(algorithm, algorithm)
        for run in members:
            own = {key: settings[run.directory].get(key) for key in keys}
            known = {key: value for key, value in own.items() if value is not None}
            names[run.directory] = title + _in_brackets(known)
    return names


def _learning_settings(run: Run) -> Settings:
    settings = {
        key: value
        for key, value in flatten(run.config).items()
        if key.partition(".")[0] not in {"env", *MANNER} and not key.endswith(".compile")
    }
    if run.init_from is not None:
        settings["init_from"] = common_source(str(run.init_from))
    return _without_presets_for_robots(settings, run)


def _without_presets_for_robots(settings: Settings, run: Run) -> Settings:
    """Leave out what is as the preset has it for the robot: it holds that in ``paper.<key>``."""
    robot = Path(str(run.config["env"].get("robot_base"))).stem

    def of_robot(key: str) -> Hashable:
        places = (f"paper.{key}.{name}" for name in (robot, "point"))
        return next((settings[place] for place in places if place in settings), None)

    return {key: value for key, value in settings.items() if value != of_robot(key)}


def _in_brackets(settings: Mapping[str, Hashable]) -> str:
    """Settings as on the command line, ``" (frames=1000)"``, or nothing."""
    texts = []
    for key, value in settings.items():
        if key.endswith("._target_"):
            key, value = key.removesuffix("._target_"), str(value).rpartition(".")[2]
        is_limit = key.startswith("cost_limits.")
        relation = " ≤ " if is_limit else "="
        texts.append(f"{key.removeprefix('cost_limits.')}{relation}{_text(value)}")
    return f" ({', '.join(texts)})" if texts else ""


def _text(value: Hashable) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, tuple):
        return f"[{','.join(map(_text, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
