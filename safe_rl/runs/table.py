"""A run's table: a CSV file with a row per epoch, and what its rows say of return and costs.

A `row` is one epoch, or the final figures of a run, by column; a `table` is all of it by columns. A
`limit` is d, the undiscounted cost allowed per episode, of the cost `key`; `limits` are those of
all costs. `measure` names the limited measure of episode costs, see `identity.measure_of`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean

from safe_rl.files import read_bounded, replace_text

# largest size of a table [bytes]; ten thousand epochs with a hundred columns have about 20 million
MOST_BYTES = 100_000_000
_MOST_COLUMNS = 10_000


class TableError(ValueError):
    """A table that is not as its run has written it."""


class TableWriter:
    """Append rows of numbers to a CSV file; the first row fixes the columns.

    NaN becomes an empty field. Numbers are written so that they read back exactly, whole ones
    without a decimal point.

    Args:
        path: File to write. An existing one is replaced.
        keep_rows: Number of rows of an existing file to keep, for a run that continues.

    Raises:
        TableError: If there are fewer rows than are to be kept, or one cannot be read; from
            `write`, if a row's columns differ from those of the first row.

    Examples:
        >>> path = getfixture("tmp_path") / "progress.csv"
        >>> table = TableWriter(path)
        >>> table.write({"epoch": 1, "episode_return": math.nan})
        >>> table.write({"epoch": 2, "episode_return": 0.5})
        >>> read_table(path)["episode_return"]
        [nan, 0.5]
    """

    def __init__(self, path: Path, keep_rows: int = 0) -> None:
        self._path = path
        self._columns: list[str] | None = None
        kept: list[str] = []
        if keep_rows:
            kept = _complete_lines(path)[: keep_rows + 1] if path.exists() else []
            if len(kept) <= keep_rows:
                raise TableError(
                    f"{path} holds {max(0, len(kept) - 1)} complete rows, but the run that is to "
                    f"be continued has finished {keep_rows} epochs: the table has been changed or "
                    "cut off. Restore it to continue, or begin a new run from the networks with "
                    "init_from=."
                )
            self._columns = list(_columns_of(path, kept))
        # replaced atomically: a run killed here still has its table
        replace_text(path, "".join(kept))

    def write(self, row: Mapping[str, float]) -> None:
        """Append a row."""
        lines = [[_field(value) for value in row.values()]]
        if self._columns is None:
            self._columns = list(row)
            lines.insert(0, self._columns)
        if list(row) != self._columns:
            unexpected = sorted(set(row).symmetric_difference(self._columns))
            raise TableError(
                f"Every row of progress.csv must have the columns of the first, in the same order; "
                f"these are in one of the two only: {unexpected}. If the file has been changed, "
                "restore it; report a diagnostic in every epoch, as NaN where it does not exist."
            )
        with self._path.open("a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows(lines)


def _complete_lines(path: Path) -> list[str]:
    """Lines of a table without the last one if its end is still missing."""
    try:
        lines = read_bounded(path, MOST_BYTES).decode("utf-8-sig").splitlines(keepends=True)
    except UnicodeDecodeError:
        raise TableError(f"{path} is no table: it is not text.") from None
    return [line for line in lines if line.endswith("\n")]


def _field(value: float) -> str:
    if math.isnan(value):
        return ""
    return str(int(value)) if float(value).is_integer() else repr(float(value))


def _columns_of(path: Path, lines: Sequence[str]) -> dict[str, list[float]]:
    """Numbers of a table by columns; a TableError says which line or field is wrong."""
    names, *rows = csv.reader(lines)
    if len(names) > _MOST_COLUMNS:
        raise TableError(f"{path} has {len(names):,} columns, more than any run writes.")
    if len({*names}) < len(names):
        raise TableError(f"{path} has two columns of one name: {','.join(names)}.")
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise TableError(
                f"{path}, line {number} has {len(row)} fields and the header {len(names)}: the "
                "table has been changed. Restore it."
            )
    try:
        columns = zip(*rows, strict=True) if rows else ([] for _ in names)
        # always the same NaN object: tables with equal numbers are equal
        return {
            name: [float(field) if field else math.nan for field in column]
            for name, column in zip(names, columns, strict=True)
        }
    except ValueError as error:
        raise TableError(f"{path} has a field that is no number: {error}.") from None


def read_table(path: Path) -> dict[str, list[float]]:
    """Read a table by columns; empty fields are NaN.

    A last line without its end, which a killed run may leave, is not read.

    Raises:
        TableError: If the file has been changed.
        ValueError: If the file is empty, or larger than any table of a run.
    """
    lines = _complete_lines(path)
    if not lines:
        raise ValueError(f"{path} is empty: the run has not finished an epoch.")
    return _columns_of(path, lines)


FINAL_EPOCHS = 5
"""Epochs over which the final J_r and J_c are averaged (Ray et al. 2019, section 5.1)."""

FINAL_STEPS = 100_000
"""Steps that the averaged epochs cover, if the run is long: five epochs of SAC have 25 episodes."""


def violation(row: Mapping[str, float], key: str, limit: float) -> float:
    """Amount by which a limit is exceeded; negative within it, NaN where no episode has finished.

    This is J_c − d, or the column ``violation_<key>`` if there is one: an algorithm that limits
    another measure than the mean cost of an episode writes its own violation there.

    Examples:
        >>> violation({"episode_cost": 30.0}, "cost", 25.0)
        5.0
        >>> violation({"episode_cost": 30.0, "violation_cost": 62.0}, "cost", 25.0)
        62.0
    """
    written = row.get(f"violation_{key}", math.nan)
    return row[f"episode_{key}"] - limit if math.isnan(written) else written


def measured(row: Mapping[str, float], key: str, limit: float | None, measure: str) -> float:
    """The measure that is compared with a limit; without a limit, the mean episode cost.

    Examples:
        >>> row = {"episode_cost": 30.0, "violation_cost": 62.0}
        >>> measured(row, "cost", 25.0, "CVaR"), measured(row, "cost", 25.0, "mean")
        (87.0, 30.0)
    """
    if limit is None or measure == "mean":
        return row[f"episode_{key}"]
    return limit + violation(row, key, limit)


def keeps(row: Mapping[str, float], key: str, limit: float) -> bool:
    """Whether an epoch keeps a limit, by its episodes and by the algorithm's own estimate.

    The few episodes of one epoch may keep a limit by chance. An algorithm that tracks J_c writes
    the columns ``estimate_<key>`` and ``target_<key>``. Then its estimate may not exceed its target
    either.

    Examples:
        >>> keeps({"episode_cost": 20.0}, "cost", 25.0)
        True
        >>> keeps({"episode_cost": 20.0, "estimate_cost": 24.0, "target_cost": 22.0}, "cost", 25.0)
        False
    """
    estimate = row.get(f"estimate_{key}", -math.inf)
    target = min(limit, row.get(f"target_{key}", limit))
    return violation(row, key, limit) <= 0 and estimate <= target


def _mean_of_known(values: Iterable[float]) -> float:
    """Mean of the numbers among values; NaN if there is none."""
    known = [value for value in values if not math.isnan(value)]
    return fmean(known) if known else math.nan


def feasible_return(
    latest: Sequence[Mapping[str, float]], limits: Mapping[str, float]
) -> float | None:
    """Mean return of a run's latest epochs, at least one, if their means keep every limit.

    Otherwise None.

    Examples:
        >>> rows = [{"episode_return": 4.0, "episode_cost": 29.0}]
        >>> rows.append({"episode_return": 6.0, "episode_cost": 20.0})
        >>> feasible_return(rows, {"cost": 25.0}), feasible_return(rows[:1], {"cost": 25.0})
        (5.0, None)
    """
    mean = {name: _mean_of_known(row[name] for row in latest) for name in latest[0]}
    is_feasible = all(keeps(mean, key, limit) for key, limit in limits.items())
    score = mean["episode_return"]
    return score if is_feasible and not math.isnan(score) else None


def final_width(steps: Iterable[float]) -> int:
    """Number of epochs over which final figures, and the moving means of curves, are taken.

    At least ``FINAL_EPOCHS``, and enough to cover ``FINAL_STEPS`` or a fifth of the run, whichever
    is less. ``steps`` are those at the end of every epoch in which an episode finished.

    Examples:
        >>> [final_width(range(epoch, 1_000_001, epoch)) for epoch in (20_000, 5_000)]
        [5, 20]
    """
    ends = list(steps)
    last = max(ends, default=0)
    begin = last - min(FINAL_STEPS, last / 5)
    return max(FINAL_EPOCHS, sum(end > begin for end in ends))


def final_rows(table: Mapping[str, Sequence[float]]) -> list[int]:
    """The last rows of a run's table in which an episode finished, `final_width` of them.

    Examples:
        >>> returns = [1.0 if epoch % 5 == 4 else math.nan for epoch in range(100)]
        >>> final_rows({"steps": range(10_000, 1_000_001, 10_000), "episode_return": returns})
        [79, 84, 89, 94, 99]
    """
    known = [row for row, value in enumerate(table["episode_return"]) if not math.isnan(value)]
    return known[-final_width([table["steps"][row] for row in known]) :]


def final_figures(
    table: Mapping[str, Sequence[float]], cost_keys: Sequence[str]
) -> dict[str, float]:
    """Final J_r, J_c and ρ_c (Ray et al. 2019, section 5.1), and steps per second of the run.

    J_r, J_c and violations of limits are means over the last `final_width` epochs in which an
    episode finished; ρ_c is that of the last epoch.
    """
    costs = [f"{kind}_{key}" for key in cost_keys for kind in ("episode", "violation")]
    names = ["episode_return", *(name for name in costs if name in table)]
    rows = final_rows(table)
    final = {name: _mean_of_known(table[name][row] for row in rows) for name in names}
    final |= {f"{key}_rate": table[f"{key}_rate"][-1] for key in cost_keys}
    final["steps_per_second"] = table["steps"][-1] / table["time_total"][-1]
    return final


def outcome_line(
    table: Mapping[str, Sequence[float]],
    limits: Mapping[str, float],
    episode_length: int | None,
    measure: str,
) -> str:
    """One line about the end of a run: return and costs over its last epochs.

    Examples:
        >>> table = {"steps": [1000, 2000], "time_total": [2.0, 4.0], "cost_rate": [0.03, 0.03]}
        >>> table |= {"episode_return": [1.0, 2.0], "episode_cost": [30.0, 20.0]}
        >>> outcome_line(table, {"cost": 25.0}, 1000, "mean")
        'Return 1.50, cost 25.0 (limit 25) per episode, mean of steps 1 to 2,000; 500 steps/s'
        >>> outcome_line(table | {"episode_return": [math.nan] * 2}, {"cost": 25.0}, 1000, "mean")
        'No episode of 1,000 steps has ended; 500 steps/s'
        >>> outcome_line(table | {"episode_return": [math.nan] * 2}, {"cost": 25.0}, None, "mean")
        'No episode has ended; 500 steps/s'
    """
    keys = list(limits) or ["cost"]
    final, rows = final_figures(table, keys), final_rows(table)
    speed = f"{final['steps_per_second']:,.0f} steps/s"
    if not rows:
        steps = "" if episode_length is None else f" of {episode_length:,} steps"
        return f"No episode{steps} has ended; {speed}"
    what = f"Return {final['episode_return']:.2f}"
    for key in keys:
        mean, limited = final[f"episode_{key}"], measured(final, key, limits.get(key), measure)
        what += f", {key} {mean:.1f}"
        what += f", limited measure {limited:.1f}" if abs(limited - mean) > 0.05 else ""
        what += f" (limit {limits[key]:g})" if key in limits else ""
    begin = 0 if rows[0] == 0 else table["steps"][rows[0] - 1]
    span = f"steps {begin + 1:,.0f} to {table['steps'][rows[-1]]:,.0f}"
    return f"{what} per episode, mean of {span}; {speed}"
