"""The normalised tables of the paper, ours beside the published, and the table of gaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from safe_rl.reporting.slates import Aggregate, Gap
from safe_rl.reporting.tables import (
    Column,
    Table,
    mark_best,
    number,
    plain,
    power_of_ten,
    with_interval,
)
from safe_rl.scores.dominance import NOISE_OF_ZERO, Agent, compare
from safe_rl.scores.published import PUBLISHED, PUBLISHED_STEPS, Normalised
from safe_rl.scores.slates import SLATES

__all__ = ["SYMBOLS", "gap_table", "middle_table", "slate_table"]

SYMBOLS = dict(
    zip(Normalised._fields, (r"$\bar J_r$", r"$\bar M_c$", r"$\bar \rho_c$"), strict=True)
)
"""Score -> its symbol."""

_Record = Mapping[str, Any]


def slate_table(slate: str, aggregates: Sequence[Aggregate]) -> Table:
    """One of the paper's Tables 1 and 2, the published values beside ours."""
    records = [_record(slate, aggregate) for aggregate in aggregates]
    steps = {aggregate.algorithm: aggregate.steps for aggregate in aggregates}
    marks = {
        name: mark_best(
            records, name, best,
            is_able=lambda r: r["violation"] <= NOISE_OF_ZERO,
            steps=lambda r: steps[r["algorithm"]],
        )
        for name, best in (("episode_return", max), ("cost_rate", min))
    }  # fmt: skip
    marks["violation"] = lambda r: "bad" if r["violation"] > NOISE_OF_ZERO else ""
    columns = [
        Column("algorithm", plain("algorithm"), is_number=False),
        Column("runs", plain("runs")),
        Column("steps", _steps),
    ]
    for name, symbol in SYMBOLS.items():
        columns.append(Column(symbol, number(name, 3), marks[name]))
    if slate in PUBLISHED:
        for name, symbol in SYMBOLS.items():
            columns.append(Column(f"paper {symbol}", number(f"paper_{name}", 3)))
    notes = [_relations(aggregates), _published_steps(slate) if slate in PUBLISHED else ""]
    return Table(f"slate_{slate}", slate, columns, records, " ".join(filter(None, notes)))


def _published_steps(slate: str) -> str:
    """After how many steps the published values were measured."""
    steps = {PUBLISHED_STEPS[environment] for environment in SLATES[slate]}
    texts = [power_of_ten(number) for number in sorted(steps)]
    doggo = " (Doggo)" if len(texts) > 1 else ""
    return f"The paper's values are those after {' and '.join(texts)}{doggo} steps."


def middle_table(slate: str, aggregates: Sequence[Aggregate]) -> Table:
    """Interquartile means over all runs with their intervals."""
    records = []
    for aggregate in aggregates:
        record = {"slate": slate, "algorithm": aggregate.algorithm, "runs": aggregate.num_runs}
        for name, estimate in aggregate.middle.items():
            record |= {
                name: estimate.value,
                f"{name}_low": estimate.low,
                f"{name}_high": estimate.high,
            }
        records.append(record)
    columns = [Column("algorithm", plain("algorithm"), is_number=False)]
    columns += [Column(f"IQM {s}", with_interval(name, 3)) for name, s in SYMBOLS.items()]
    return Table(f"slate_{slate}_iqm", f"{slate}, interquartile means", columns, records)


def _record(slate: str, aggregate: Aggregate) -> dict[str, Any]:
    record: dict[str, Any] = {
        "slate": slate,
        "algorithm": aggregate.algorithm,
        "runs": aggregate.num_runs,
        "fewest_steps": min(aggregate.steps),
        "most_steps": max(aggregate.steps),
        **aggregate.mean._asdict(),
    }
    published = PUBLISHED.get(slate, {}).get(aggregate.published)
    if published is not None:
        record |= {f"paper_{name}": value for name, value in published._asdict().items()}
    return record


def _steps(record: _Record) -> str:
    ends = dict.fromkeys((record["fewest_steps"], record["most_steps"]))
    return " to ".join(f"{steps:,}" for steps in ends)


def _relations(aggregates: Sequence[Aggregate]) -> str:
    """Who fails, and who dominates whom, in words."""
    agents = {
        aggregate.algorithm: Agent(
            aggregate.mean.episode_return,
            aggregate.mean.cost_rate,
            aggregate.mean.violation <= NOISE_OF_ZERO,
            aggregate.steps,
        )
        for aggregate in aggregates
    }
    failing = [name for name, agent in agents.items() if not agent.is_satisfying]
    pairs = [f"{a} ≻ {b}" for a, b, reason in compare(agents) if reason == "dominates"]
    parts = []
    if failing:
        parts.append(
            f"Violate the constraint ({SYMBOLS['violation']} above {NOISE_OF_ZERO:g}), and so are "
            f"worse than any that does not: {', '.join(failing)}."
        )
    if len(agents) - len(failing) > 1:
        parts.append(f"{'; '.join(pairs)}." if pairs else "None of the others dominates another.")
    return " ".join(parts)


def gap_table(gaps: Sequence[Gap]) -> Table:
    """Which runs the slates still lack, and the commands that do them."""
    records = [
        {
            "slate": gap.slate,
            "algorithm": gap.algorithm,
            "runs": gap.num_runs,
            "environments": ", ".join(
                f"{name} (seeds {', '.join(map(str, seeds))})" for name, seeds in gap.seeds.items()
            ),
            "commands": "\n".join(gap.commands()),
            "is_begun": gap.is_begun,
        }
        for gap in gaps
    ]
    columns = [
        Column("slate", plain("slate"), is_number=False),
        Column("algorithm", plain("algorithm"), is_number=False),
        Column("runs", plain("runs")),
        Column("of", plain("environments"), is_number=False),
        Column("command", plain("commands"), is_number=False),
    ]
    return Table("missing", "What slates still lack", columns, records)
