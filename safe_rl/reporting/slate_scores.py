"""Normalised scores over slates of environments (paper section 5.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from safe_rl.reporting.columns import Column, Table, interval, mark_best, power_of_ten, span
from safe_rl.reporting.experiments import Experiment
from safe_rl.scores.comparisons import probability_of_improvement
from safe_rl.scores.dominance import NOISE_OF_ZERO, Agent, compare
from safe_rl.scores.intervals import Estimate, interquartile_mean
from safe_rl.scores.normalised import normalised_cost_rate, normalised_return, normalised_violation
from safe_rl.scores.published import PUBLISHED, PUBLISHED_STEPS, Normalised
from safe_rl.scores.slates import SLATES

__all__ = [
    *("SYMBOLS", "Aggregate", "aggregate", "by_length", "can_be_normalised", "improvement_table"),
    *("middle_table", "normalised_scores", "slate_table", "title_of"),
]

SYMBOLS = dict(
    zip(Normalised._fields, (r"$\bar J_r$", r"$\bar M_c$", r"$\bar \rho_c$"), strict=True)
)
"""Score -> its symbol."""


@dataclass(frozen=True)
class Aggregate:
    """An algorithm's normalised scores over a set of environments.

    Attributes:
        algorithm: Its name, as experiments have it.
        published: Its name in ``conf/algo``, or "" if its limits are not the published ones.
        strata: Score -> its values per environment, one of each run.
        steps: Environment steps of training, per environment; several where runs are not equally
            long, see :attr:`Experiment.lengths`.
        limits: d, per environment.
    """

    algorithm: str
    published: str
    strata: Mapping[str, list[np.ndarray]]
    steps: tuple[int, ...]
    limits: tuple[float, ...]

    @property
    def mean(self) -> Normalised:
        """Averages over environments of averages over seeds."""
        return Normalised(
            *(float(np.mean([runs.mean() for runs in self.strata[n]])) for n in Normalised._fields)
        )

    @property
    def is_measured(self) -> bool:
        """Whether every run has finished an episode."""
        return bool(np.isfinite(self.mean).all())

    @property
    def num_runs(self) -> int:
        """Runs that went into it."""
        return sum(map(len, self.strata["episode_return"]))

    def middle(self, score: str) -> Estimate:
        """Interquartile mean over all runs; its interval resamples every environment's seeds."""
        return interquartile_mean(self.strata[score])


def can_be_normalised(experiment: Experiment) -> bool:
    """Whether there is something to normalise, and something to normalise it by.

    Runs that started from other runs' networks had more training than their steps say, and do not
    count.
    """
    return (
        experiment.reference is not None
        and "cost" in experiment.limits
        and not experiment.is_continued
        and bool(experiment.finished)
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
    first = experiments[0]
    return Aggregate(
        first.algorithm,
        first.runs[0].algorithm if all(e.has_published_limit for e in experiments) else "",
        {name: [score[name] for score in scores] for name in Normalised._fields},
        tuple(steps for e in experiments for steps in e.lengths),
        tuple(e.limits["cost"] for e in experiments),
    )


def slate_table(slate: str, environments: Sequence[str], aggregates: Sequence[Aggregate]) -> Table:
    """One of the paper's Tables 1 and 2, the published values beside ours."""
    records = [_record(slate, aggregate) for aggregate in aggregates]
    rivals = {one.algorithm: (one.steps, one.limits) for one in aggregates}

    def best(name: str, of: Any) -> Any:
        return mark_best(
            records, name, of,
            is_able=lambda r: r["violation"] <= NOISE_OF_ZERO,
            steps=lambda r: rivals[r["algorithm"]],
        )  # fmt: skip

    marks = {"episode_return": best("episode_return", max), "cost_rate": best("cost_rate", min)}
    marks["violation"] = lambda r: "bad" if r["violation"] > NOISE_OF_ZERO else ""
    columns = [
        Column("algorithm"),
        Column("runs", ("{:d}", "runs")),
        Column("steps", ("{:,}", "fewest_steps"), (" to {:,}", "most_steps")),
        *(Column(s, ("{:.3f}", name), mark=marks[name]) for name, s in SYMBOLS.items()),
    ]
    if slate in PUBLISHED:
        columns += [Column(f"paper {s}", ("{:.3f}", f"paper_{n}")) for n, s in SYMBOLS.items()]
    notes = [f"On {', '.join(environments)}.", _relations(aggregates)]
    notes += [_published_steps(slate)] if slate in PUBLISHED else []
    return Table(f"slate_{slate}", title_of(slate), columns, records, " ".join(filter(None, notes)))


def title_of(slate: str) -> str:
    """What a slate is called on the page.

    Examples:
        >>> title_of("SG6"), title_of("shared")
        ('SG6', 'What all algorithms were trained on')
    """
    return {"shared": "What all algorithms were trained on"}.get(slate, slate)


def _record(slate: str, aggregate: Aggregate) -> dict[str, Any]:
    fewest, most = min(aggregate.steps), max(aggregate.steps)
    record: dict[str, Any] = {
        "slate": slate,
        "algorithm": aggregate.algorithm,
        "runs": aggregate.num_runs,
        "fewest_steps": fewest,
        "most_steps": None if most == fewest else most,
        **aggregate.mean._asdict(),
    }
    published = PUBLISHED.get(slate, {}).get(aggregate.published)
    if published is not None:
        record |= {f"paper_{name}": value for name, value in published._asdict().items()}
    return record


def _published_steps(slate: str) -> str:
    """After how many steps the published values were measured."""
    steps = sorted({PUBLISHED_STEPS[environment] for environment in SLATES[slate]})
    doggo = " (Doggo)" if len(steps) > 1 else ""
    return (
        f"The paper's values are those after {' and '.join(map(power_of_ten, steps))}{doggo} steps."
    )


def _relations(aggregates: Sequence[Aggregate]) -> str:
    """Who fails, and who dominates whom, in words."""
    agents = {
        a.algorithm: Agent(
            a.mean.episode_return,
            a.mean.cost_rate,
            a.mean.violation <= NOISE_OF_ZERO,
            (a.steps, a.limits),
        )
        for a in aggregates
        if a.is_measured  # without an episode nothing is kept, and nothing violated
    }
    failing = [name for name, agent in agents.items() if not agent.is_satisfying]
    pairs = [f"{a} ≻ {b}" for a, b, reason in compare(agents) if reason == "dominates"]
    parts = []
    if failing:
        parts.append(
            f"Violate the constraint ({SYMBOLS['violation']} above {NOISE_OF_ZERO:g}), and so are "
            "worse than any that does not after equally many steps: " + ", ".join(failing) + "."
        )
    if len(agents) - len(failing) > 1:
        parts.append(f"{'; '.join(pairs)}." if pairs else "None of the others dominates another.")
    return " ".join(parts)


def by_length(aggregates: Sequence[Aggregate]) -> dict[str, list[Aggregate]]:
    """Aggregates by how long they were trained, in words: only equally long training compares.

    The words are empty where all were trained for equally many steps.
    """
    groups: dict[tuple[int, ...], list[Aggregate]] = {}
    for one in sorted(aggregates, key=lambda one: one.steps):
        groups.setdefault(one.steps, []).append(one)
    if len(groups) == 1:
        return {"": list(aggregates)}
    return {f", {span(steps)} steps": members for steps, members in groups.items()}


def middle_table(slate: str, aggregates: Sequence[Aggregate], after: str = "") -> Table:
    """Interquartile means over all runs with their intervals.

    Args:
        slate: Its name.
        aggregates: One per algorithm.
        after: How long they were trained, see :func:`by_length`.
    """
    records = []
    for one in aggregates:
        record: dict[str, Any] = {
            "slate": slate, "algorithm": one.algorithm, "runs": one.num_runs,
            "fewest_steps": min(one.steps), "most_steps": max(one.steps),
        }  # fmt: skip
        for name in SYMBOLS:
            value, low, high = one.middle(name)
            record |= {name: value, f"{name}_low": low, f"{name}_high": high}
        records.append(record)
    columns = [Column("algorithm")]
    columns += [Column(f"IQM {s}", *interval(name, 3)) for name, s in SYMBOLS.items()]
    title = f"{title_of(slate)}, interquartile means{after}"
    return Table(f"slate_{slate}_iqm", title, columns, records)


def improvement_table(slate: str, aggregates: Sequence[Aggregate]) -> Table:
    """How likely a run of one algorithm is better than one of another, in each score.

    Pairs that were trained for equally many steps, each once; two single runs have no probability.
    """
    records = []
    for first, second in combinations(aggregates, 2):
        if first.steps != second.steps or max(first.num_runs, second.num_runs) == 1:
            continue
        record: dict[str, Any] = {
            "slate": slate, "algorithm": first.algorithm, "other": second.algorithm,
        }  # fmt: skip
        for name in SYMBOLS:
            pair = (first, second) if name == "episode_return" else (second, first)
            value, low, high = probability_of_improvement(*(one.strata[name] for one in pair))
            record |= {name: value, f"{name}_low": low, f"{name}_high": high}
        records.append(record)
    columns = [Column(name) for name in ("algorithm", "other")]
    titles = zip(SYMBOLS, ("higher", "lower", "lower"), strict=True)
    columns += [Column(f"{how} {SYMBOLS[name]}", *interval(name, 2)) for name, how in titles]
    title = f"{title_of(slate)}, probability of improvement"
    note = "Each pair once: the other way round it is one minus the number."
    return Table(f"slate_{slate}_improvement", title, columns, records, note)
