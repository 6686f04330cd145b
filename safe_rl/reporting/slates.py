"""Normalised scores over slates of environments (paper section 5.1), and the runs they lack."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from safe_rl.reporting.experiments import Experiment
from safe_rl.reporting.tables import Column, Table, interval, mark_best, power_of_ten, span
from safe_rl.runs.identity import Role, role_of
from safe_rl.scores.benchmark import SLATES
from safe_rl.scores.comparisons import Estimate, interquartile_mean, probability_of_improvement
from safe_rl.scores.measures import (
    NOISE_OF_ZERO,
    Agent,
    compare,
    normalised_cost_rate,
    normalised_return,
    normalised_violation,
)
from safe_rl.scores.published import PUBLISHED, PUBLISHED_STEPS, REFERENCE, SEEDS, Normalised

__all__ = [
    *("SYMBOLS", "Aggregate", "aggregate", "by_length", "can_be_normalised", "complete_slates"),
    *("improvement_table", "middle_table", "missing_runs_table", "missing_seeds"),
    *("normalised_scores", "slate_table", "title_of_slate"),
]

SYMBOLS = dict(
    zip(Normalised._fields, (r"$\bar J_r$", r"$\bar M_c$", r"$\bar \rho_c$"), strict=True)
)
"""Score -> its symbol."""
# groups that a command for missing runs chooses itself
_MISSING = ("slate", "algorithm", "runs", "commands")
_CHOSEN = {"env", "algo", "slate", "init_from", "hydra"}


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
    """Whether there is something to normalise, and a reference; continued runs do not count."""
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


def complete_slates(
    experiments: Sequence[Experiment], needed: int
) -> Iterator[tuple[str, tuple[str, ...], list[Aggregate]]]:
    """Slates that are complete for an algorithm or more, and what all have in common.

    Yields:
        Name of a slate, its environments, and an aggregate of each algorithm.
    """
    begun = [e for e in experiments if e.benchmark in REFERENCE and not e.is_continued]
    algorithms = list(dict.fromkeys(e.algorithm for e in begun))
    usable = [e for e in experiments if can_be_normalised(e)]
    on = {name: {e.algorithm for e in usable if e.benchmark == name} for name in REFERENCE}
    shared = tuple(n for n in REFERENCE if algorithms and on[n] == set(algorithms))
    slates = [
        (name, slate, [a for a in algorithms if not missing_seeds(name, a, experiments, needed)])
        for name, slate in SLATES.items()
    ]
    if shared and shared not in [slate for _, slate, members in slates if members]:
        slates.append(("shared", shared, algorithms))
    for name, slate, members in slates:
        own = [[e for e in usable if e.algorithm == a and e.benchmark in slate] for a in members]
        if own:
            yield name, slate, list(map(aggregate, own))


def slate_table(slate: str, environments: Sequence[str], aggregates: Sequence[Aggregate]) -> Table:
    """One of the paper's Tables 1 and 2, the published values beside ours."""
    records = [_record(slate, aggregate) for aggregate in aggregates]
    lengths = {one.algorithm: (one.steps, one.limits) for one in aggregates}

    def best(name: str, of: Any) -> Any:
        return mark_best(
            records, name, of,
            is_able=lambda r: r["violation"] <= NOISE_OF_ZERO,
            rivals=lambda r: lengths[r["algorithm"]],
        )  # fmt: skip

    marks = {"episode_return": best("episode_return", max), "cost_rate": best("cost_rate", min)}
    marks["violation"] = lambda r: "bad" if r["violation"] > NOISE_OF_ZERO else ""
    columns = [
        Column("algorithm"),
        Column("runs", ("{:d}", "runs")),
        Column("steps", ("{:,}", "fewest_steps"), (" to {:,}", "most_steps")),
        *(Column(s, ("{:.3f}", name), mark=marks[name]) for name, s in SYMBOLS.items()),
    ]
    notes = [f"On {', '.join(environments)}.", _relations(aggregates)]
    if slate in PUBLISHED:
        columns += [Column(f"paper {s}", ("{:.3f}", f"paper_{n}")) for n, s in SYMBOLS.items()]
        steps = sorted({PUBLISHED_STEPS[environment] for environment in SLATES[slate]})
        doggo = " (Doggo)" if len(steps) > 1 else ""
        after = " and ".join(map(power_of_ten, steps))
        notes.append(f"The paper's values are those after {after}{doggo} steps.")
    note = " ".join(filter(None, notes))
    return Table(f"slate_{slate}", title_of_slate(slate), columns, records, note)


def title_of_slate(slate: str) -> str:
    """What a slate is called on the page.

    Examples:
        >>> title_of_slate("SG6"), title_of_slate("shared")
        ('SG6', 'What all algorithms were trained on')
    """
    return {"shared": "What all algorithms were trained on"}.get(slate, slate)


def _record(slate: str, aggregate: Aggregate) -> dict[str, Any]:
    fewest, most = min(aggregate.steps), max(aggregate.steps)
    published = PUBLISHED.get(slate, {}).get(aggregate.published)
    return {
        "slate": slate,
        "algorithm": aggregate.algorithm,
        "runs": aggregate.num_runs,
        "fewest_steps": fewest,
        "most_steps": None if most == fewest else most,
        **aggregate.mean._asdict(),
        **{f"paper_{n}": value for n, value in (published._asdict() if published else {}).items()},
    }


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


def _with_interval(name: str, estimate: Estimate) -> dict[str, float]:
    return dict(zip((name, f"{name}_low", f"{name}_high"), estimate, strict=True))


def middle_table(slate: str, aggregates: Sequence[Aggregate], after: str = "") -> Table:
    """Interquartile means over all runs with their intervals, of one group of :func:`by_length`."""
    records = []
    for one in aggregates:
        record: dict[str, Any] = {
            "slate": slate, "algorithm": one.algorithm, "runs": one.num_runs,
            "fewest_steps": min(one.steps), "most_steps": max(one.steps),
        }  # fmt: skip
        for name in SYMBOLS:
            record |= _with_interval(name, one.middle(name))
        records.append(record)
    columns = [Column("algorithm")]
    columns += [Column(f"IQM {s}", *interval(name, 3)) for name, s in SYMBOLS.items()]
    title = f"{title_of_slate(slate)}, interquartile means{after}"
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
            estimate = probability_of_improvement(*(one.strata[name] for one in pair))
            record |= _with_interval(name, estimate)
        records.append(record)
    columns = [Column(name) for name in ("algorithm", "other")]
    titles = zip(SYMBOLS, ("higher", "lower", "lower"), strict=True)
    columns += [Column(f"{how} {SYMBOLS[name]}", *interval(name, 2)) for name, how in titles]
    title = f"{title_of_slate(slate)}, probability of improvement"
    note = "Each pair once: the other way round it is one minus the number."
    return Table(f"slate_{slate}_improvement", title, columns, records, note)


def missing_seeds(
    slate: str, algorithm: str, experiments: Sequence[Experiment], needed: int
) -> dict[str, tuple[int, ...]]:
    """Environment of a slate -> seeds that an algorithm still lacks on it.

    The published seeds come first, then further multiples of ten.
    """
    own = [e for e in experiments if e.algorithm == algorithm and can_be_normalised(e)]
    done = {e.benchmark: {run.seed for run in e.finished} for e in own}
    missing = {}
    for environment in SLATES[slate]:
        seeds = done.get(environment, set())
        further = range(max(SEEDS) + 10, max(SEEDS) + 10 * (needed + len(seeds) + 1), 10)
        left = [seed for seed in (*SEEDS, *further) if seed not in seeds]
        if len(seeds) < needed:
            missing[environment] = tuple(left[: needed - len(seeds)])
    return missing


def missing_runs_table(experiments: Sequence[Experiment], needed: int) -> Table:
    """What slates lack of algorithms with runs on a third of their environments, and commands."""
    records = []
    afresh = [e for e in experiments if not e.is_continued]
    for slate, environments in SLATES.items():
        begun = [e for e in afresh if e.benchmark in environments]
        for algorithm in dict.fromkeys(e.algorithm for e in begun):
            own = [e for e in begun if e.algorithm == algorithm]
            missing = missing_seeds(slate, algorithm, experiments, needed)
            if missing and 3 * len({e.benchmark for e in own}) >= len(environments):
                commands = "\n".join(_commands(own, missing)) or "not recorded"
                number = sum(map(len, missing.values()))
                words = (slate, algorithm, number, commands)
                records.append(dict(zip(_MISSING, words, strict=True)))
    columns = [Column(name, *([("{:d}", name)] if name == "runs" else [])) for name in _MISSING]
    note = "Slates of which an algorithm has runs on less than a third are not listed."
    return Table("missing", "What slates still lack", columns, records, note)


def _commands(
    experiments: Sequence[Experiment], missing: Mapping[str, tuple[int, ...]]
) -> Iterator[str]:
    """Command lines for missing runs: a sweep for every set of seeds; none if none is recorded."""
    known = [run for e in experiments for run in e.runs if run.overrides is not None]
    if not known:
        return
    run = known[0]
    kept = [override for override in run.overrides or () if _is_of_the_algorithm(override)]
    for seeds in dict.fromkeys(missing.values()):
        environments = ",".join(name for name, own in missing.items() if own == seeds)
        words = ["python", "train.py", "-m", f"env={environments}", f"algo={run.algorithm}", *kept]
        yield shlex.join([*words, f"seed={','.join(map(str, seeds))}"])


def _is_of_the_algorithm(override: str) -> bool:
    """Whether it may change results: the way in which environments are stepped may, too."""
    key = override.lstrip("+~").partition("=")[0]
    group = key.partition(".")[0].partition("@")[0]
    if group == "import":
        return True
    return group not in _CHOSEN and role_of(key) not in (Role.SEED, Role.MACHINE)
