"""Experiments: runs that differ in nothing but the seed."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from safe_rl.reporting.naming import algorithm_names, environment_names
from safe_rl.reporting.origins import Origin
from safe_rl.reporting.recorded import Run
from safe_rl.scores.benchmark import Suite
from safe_rl.scores.published import ALGORITHMS, COST_LIMIT, REFERENCE, Scores

__all__ = ["Experiment", "cost_keys_of", "group_runs"]


@dataclass(frozen=True)
class Experiment:
    """One algorithm on one environment.

    Attributes:
        environment: Name of the environment, with what was changed of it.
        algorithm: Name of the algorithm, with what tells it from others of that name.
        benchmark: Name in the suite if the environment is exactly that one, else None.
        runs: One per seed.
        family: Name of the algorithm where limits are no difference, so that the same algorithm
            under several limits has one; "" is a family of its own.
        settings: All that differs from its namesakes, if that is more than its name says.
    """

    environment: str
    algorithm: str
    benchmark: str | None
    runs: tuple[Run, ...]
    family: str = ""
    settings: str = ""

    @property
    def reference(self) -> Scores | None:
        """Characteristic metrics to normalise by, if the environment has them."""
        return REFERENCE.get(self.benchmark or "")

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

    @property
    def lengths(self) -> tuple[int, ...]:
        """Environment steps of its finished runs, ascending, each number once.

        It is one number, unless unfinished runs count as finished.
        """
        return tuple(sorted({run.length for run in self.finished}))


def cost_keys_of(experiments: Iterable[Experiment]) -> list[str]:
    """The aggregate cost if there is one, and every cost key that an experiment limits."""
    experiments = list(experiments)
    has_cost = any("cost_rate" in run.table for e in experiments for run in e.runs)
    limited = [key for experiment in experiments for key in experiment.limits]
    return list(dict.fromkeys([*(["cost"] if has_cost else []), *limited]))


def group_runs(
    runs: Sequence[Run], suite: Suite, origins: Mapping[Path, Origin], root: Path
) -> tuple[list[Experiment], dict[Path, str]]:
    """Group runs into experiments.

    Args:
        runs: Runs of any environments and algorithms.
        suite: The benchmark.
        origins: Folder of a run -> what it started from.
        root: Folder of all runs.

    Returns:
        Experiments in the order of the benchmark and of the paper's tables, and folder -> why a
        run was left out.
    """
    environments = environment_names(runs, suite)
    algorithms = algorithm_names(runs, environments, origins, root)
    families = algorithm_names(runs, environments, origins, root, but_for="cost_limits")
    cells: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs:
        cells[environments[run.directory], algorithms[run.directory].name].append(run)
    skipped: dict[Path, str] = {}
    experiments = []
    for (environment, algorithm), members in cells.items():
        kept = _without_repetitions(members, skipped)
        benchmark = suite.name_of(kept[0].config["env"])
        first = kept[0].directory
        further = (families[first].name, algorithms[first].settings)
        experiments.append(Experiment(environment, algorithm, benchmark, tuple(kept), *further))
    return sorted(experiments, key=_order), skipped


def _order(experiment: Experiment) -> tuple[Hashable, ...]:
    """Benchmark environments first, algorithms as in the paper, variants behind each other."""
    benchmarks, names = list(REFERENCE), list(ALGORITHMS)
    name = experiment.runs[0].algorithm
    return (
        benchmarks.index(experiment.benchmark) if experiment.benchmark in benchmarks else 99,
        experiment.environment,
        names.index(name) if name in names else 99,
        experiment.algorithm,
    )


def _without_repetitions(runs: Sequence[Run], skipped: dict[Path, str]) -> list[Run]:
    """Runs by ascending seed, the same seed once: twice it would be one sample, not two.

    The one that has come further is kept, among equals the last by their folders, which have dates
    for names: when files were written a copy or a clone does not tell. The others are noted.
    """
    kept: dict[int, Run] = {}
    for run in sorted(runs, key=lambda run: (run.steps, run.directory)):
        if run.seed in kept:
            reason = f"{run.directory} is the same run with the same seed"
            skipped[kept[run.seed].directory] = reason
        kept[run.seed] = run
    return [kept[seed] for seed in sorted(kept)]
