"""Normalised scores over slates of environments (paper section 5.1), and what slates lack."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from safe_rl.reporting.experiments import MANNER, Experiment
from safe_rl.reporting.runs import Run
from safe_rl.scores.intervals import Estimate, interquartile_mean
from safe_rl.scores.normalised import normalised_cost_rate, normalised_return, normalised_violation
from safe_rl.scores.published import SEEDS, Normalised
from safe_rl.scores.slates import SLATES

__all__ = ["Aggregate", "Gap", "aggregate", "can_be_normalised", "find_gap", "normalised_scores"]

# What a command leaves out: others say it, or it does not change results. Other defaults of the
# limits do, and so may the way in which environments are stepped.
_NOT_OF_THE_ALGORITHM = {"env", "algo", "slate", "init_from"} | (
    MANNER - {"default_cost_limits", "collector", "num_collectors", "import"}
)


@dataclass(frozen=True)
class Aggregate:
    """An algorithm's normalised scores over a set of environments.

    Attributes:
        algorithm: Its name, as experiments have it.
        published: Its name in ``conf/algo``, or "" if its limits are not the published ones.
        mean: Averages over environments of averages over seeds.
        middle: Score -> interquartile mean over all runs; the bootstrap of its interval resamples
            the seeds of every environment on their own.
        num_runs: Runs that went into it.
        steps: Environment steps of training, per environment.
    """

    algorithm: str
    published: str
    mean: Normalised
    middle: Mapping[str, Estimate]
    num_runs: int
    steps: tuple[int, ...]


@dataclass(frozen=True)
class Gap:
    """What a slate lacks of an algorithm.

    Attributes:
        slate: Its name.
        algorithm: Name of the algorithm, as experiments have it.
        overrides: What makes ``train.py`` run it.
        seeds: Environment -> seeds still to run.
        environments_begun: Environments that have a run, finished or not.

    Examples:
        >>> gap = Gap("SG6", "CPO", ("algo=cpo",), {"CarGoal1": (0, 10)})
        >>> gap.num_runs, gap.commands()
        (2, ['python train.py -m env=CarGoal1 algo=cpo seed=0,10'])
    """

    slate: str
    algorithm: str
    overrides: tuple[str, ...]
    seeds: Mapping[str, tuple[int, ...]]
    environments_begun: int = 0

    @property
    def is_begun(self) -> bool:
        """Whether a third of the slate's environments have a run."""
        return 3 * self.environments_begun >= len(SLATES[self.slate])

    @property
    def num_runs(self) -> int:
        """Runs still to be done."""
        return sum(map(len, self.seeds.values()))

    def commands(self) -> list[str]:
        """Command lines that do them: a sweep for every set of seeds."""
        by_seeds: dict[tuple[int, ...], list[str]] = {}
        for environment, seeds in self.seeds.items():
            by_seeds.setdefault(seeds, []).append(environment)
        return [
            shlex.join(
                [
                    *("python", "train.py", "-m", f"env={','.join(environments)}"),
                    *self.overrides,
                    f"seed={','.join(map(str, seeds))}",
                ]
            )
            for seeds, environments in by_seeds.items()
        ]


def can_be_normalised(experiment: Experiment) -> bool:
    """Whether there is something to normalise, and something to normalise it by.

    Runs that started from other runs' networks had more training than their steps say, and do not
    count.
    """
    has_limit = "cost" in experiment.limits
    is_afresh = not experiment.is_continued
    return (
        experiment.reference is not None and has_limit and is_afresh and bool(experiment.finished)
    )


def normalised_scores(experiment: Experiment) -> dict[str, np.ndarray]:
    """Normalised final scores of every finished run, each of shape [seeds].

    Raises:
        ValueError: If the environment has no reference scores, or its cost no limit.
    """
    reference, limit = experiment.reference, experiment.limits.get("cost")
    if reference is None or limit is None:
        raise ValueError(
            f"{experiment.environment} with limits {experiment.limits} cannot be normalised: it "
            "takes an environment of the benchmark and a limit of 'cost'."
        )
    finals = [run.final(["cost"]) for run in experiment.finished]
    values = {name: np.array([final[name] for final in finals]) for name in finals[0]}
    # J_c, or what the run compares with the limit in its place
    judged = limit + np.array([run.excess("cost") for run in experiment.finished])
    return {
        "episode_return": normalised_return(values["episode_return"], reference),
        "violation": normalised_violation(judged, limit, reference),
        "cost_rate": normalised_cost_rate(values["cost_rate"], reference),
    }


def aggregate(experiments: Sequence[Experiment]) -> Aggregate:
    """Put one algorithm's experiments together, one per environment."""
    scores = [normalised_scores(experiment) for experiment in experiments]
    strata = {name: [score[name] for score in scores] for name in Normalised._fields}
    first = experiments[0]
    means = (float(np.mean([runs.mean() for runs in strata[name]])) for name in Normalised._fields)
    return Aggregate(
        algorithm=first.algorithm,
        published=first.runs[0].algorithm if first.has_published_limit else "",
        mean=Normalised(*means),
        middle={name: interquartile_mean(values) for name, values in strata.items()},
        num_runs=sum(len(experiment.finished) for experiment in experiments),
        steps=tuple(max(run.steps for run in e.finished) for e in experiments),
    )


def find_gap(
    slate: str, algorithm: str, experiments: Sequence[Experiment], seeds_needed: int
) -> Gap | None:
    """Return what a slate lacks of an algorithm, or None if it is complete.

    Args:
        slate: A name in :data:`safe_rl.scores.slates.SLATES`.
        algorithm: Name of the algorithm, as experiments have it.
        experiments: All experiments.
        seeds_needed: Finished runs that a slate takes per environment.
    """
    own = {
        e.benchmark: e
        for e in experiments
        if e.algorithm == algorithm and e.benchmark and not e.is_continued
    }
    lacking: dict[str, tuple[int, ...]] = {}
    for environment in SLATES[slate]:
        experiment = own.get(environment)
        done: set[int] = set()
        if experiment is not None and can_be_normalised(experiment):
            done = {run.seed for run in experiment.finished}
        left = _seeds_left(done, seeds_needed)
        if left:
            lacking[environment] = left
    if not lacking:
        return None
    example = next(e.runs[0] for e in experiments if e.algorithm == algorithm)
    begun = len(own.keys() & set(SLATES[slate]))
    return Gap(slate, algorithm, _overrides(example), lacking, begun)


def _seeds_left(done: set[int], seeds_needed: int) -> tuple[int, ...]:
    """Seeds to run: the published ones first, then further multiples of ten."""
    further = range(max(SEEDS) + 10, max(SEEDS) + 10 * (seeds_needed + len(done) + 1), 10)
    candidates = [seed for seed in (*SEEDS, *further) if seed not in done]
    return tuple(candidates[: max(0, seeds_needed - len(done))])


def _overrides(run: Run) -> tuple[str, ...]:
    """What a run's command line says beside environment and seed."""
    kept = []
    for override in run.overrides or ():
        key = override.lstrip("+~").partition("=")[0]
        group = key.partition(".")[0].partition("@")[0]
        if group not in _NOT_OF_THE_ALGORITHM and not key.endswith(".compile"):
            kept.append(override)
    return (f"algo={run.algorithm}", *kept)
