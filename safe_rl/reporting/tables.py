"""Tables that are written as CSV, Markdown and HTML from one description."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = [
    *("MISSING", "Cell", "Column", "Table", "limit_text", "mark_best", "number", "plain"),
    *("power_of_ten", "with_interval"),
]

MISSING = "—"
"""Shown where there is no value."""

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Cell:
    """What a reader sees of one entry.

    Attributes:
        text: The entry.
        mark: "best", "bad", or nothing.
        is_number: Whether it is set flush right.
    """

    text: str
    mark: str = ""
    is_number: bool = True


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        title: Its head.
        text: Record -> text of the entry.
        mark: Record -> "best" (bold), "bad" (red), or nothing.
        is_number: Whether it holds numbers.
    """

    title: str
    text: Callable[[Record], str]
    mark: Callable[[Record], str] = lambda record: ""
    is_number: bool = True


@dataclass(frozen=True)
class Table:
    """Records, and how they are shown.

    Attributes:
        name: Stem of the file.
        title: Its heading.
        columns: What is shown.
        records: A row each; the CSV file holds all their fields, as numbers.
        note: Said below it.

    Examples:
        >>> table = Table("t", "A table", [Column("x", number("x", 2))], [{"x": 1.23456}])
        >>> print(table.markdown())
        | x |
        |---:|
        | 1.23 |
    """

    name: str
    title: str
    columns: Sequence[Column]
    records: Sequence[Record]
    note: str = ""

    def rows(self) -> list[list[Cell]]:
        """What a reader sees."""
        return [
            [Cell(c.text(record), c.mark(record), c.is_number) for c in self.columns]
            for record in self.records
        ]

    def markdown(self) -> str:
        """The table in GitHub's Markdown."""
        head = [column.title for column in self.columns]
        rule = ["---:" if column.is_number else "---" for column in self.columns]
        rows = [
            [f"**{cell.text}**" if cell.mark == "best" else cell.text for cell in row]
            for row in self.rows()
        ]
        lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
        lines.insert(1, f"|{'|'.join(rule)}|")
        return "\n".join(lines)

    def write_csv(self, directory: Path) -> None:
        """Write the records; what is not a number becomes an empty field."""
        if not self.records:
            return
        with (directory / f"{self.name}.csv").open("w", newline="") as file:
            names = list(dict.fromkeys(name for record in self.records for name in record))
            writer = csv.DictWriter(file, names, restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows([{k: _field(v) for k, v in record.items()} for record in self.records])


def _field(value: Any) -> Any:
    return "" if value is None or (isinstance(value, float) and math.isnan(value)) else value


def number(name: str, decimals: int, spread: str | None = None) -> Callable[[Record], str]:
    """Text of a number with so many decimals, with ± its spread if there is one.

    Args:
        name: Field of the record.
        decimals: Of the number and its spread.
        spread: Field with the spread, or None.
    """

    def text(record: Record) -> str:
        value = record.get(name)
        if value is None or math.isnan(value):
            return MISSING
        deviation = math.nan if spread is None else record.get(spread, math.nan)
        shown = f"{value:.{decimals}f}"
        return shown if math.isnan(deviation) else f"{shown} ± {deviation:.{decimals}f}"

    return text


def with_interval(name: str, decimals: int) -> Callable[[Record], str]:
    """Text of an estimate with its interval in brackets, where it has one.

    Args:
        name: Field of the estimate; those of the ends add ``_low`` and ``_high``.
        decimals: Of all three.
    """
    value, low, high = (number(f"{name}{end}", decimals) for end in ("", "_low", "_high"))

    def text(record: Record) -> str:
        ends = (low(record), high(record))
        return value(record) + (f" [{', '.join(ends)}]" if MISSING not in ends else "")

    return text


def mark_best(
    records: Sequence[Record],
    name: str,
    best: Callable[..., float],
    *,
    is_able: Callable[[Record], bool],
    steps: Callable[[Record], Hashable],
) -> Callable[[Record], str]:
    """Mark of a column: "best" for the best value, and all equal to it, after equally many steps.

    What nothing else has had as many steps as is not compared, and not marked.

    Args:
        records: Rows of the table.
        name: Field of the value.
        best: ``max`` or ``min``.
        is_able: Which of them can be the best.
        steps: Environment steps of training of a record.

    Examples:
        >>> rows = [{"x": x, "steps": steps} for x, steps in ((1, 5), (2, 5), (2, 5), (9, 6))]
        >>> mark = mark_best(rows, "x", max, is_able=lambda r: True, steps=lambda r: r["steps"])
        >>> [mark(row) for row in rows]
        ['', 'best', 'best', '']
    """

    def mark(record: Record) -> str:
        rivals = [other for other in records if steps(other) == steps(record)]
        if len(rivals) < 2 or name not in record or not is_able(record):
            return ""
        winner = best(other[name] for other in rivals if name in other and is_able(other))
        return "best" if math.isclose(record[name], winner, rel_tol=1e-9) else ""

    return mark


def power_of_ten(value: int) -> str:
    """A power of ten as people write it.

    Examples:
        >>> power_of_ten(10_000_000)
        '10⁷'
    """
    return f"10{str(round(math.log10(value))).translate(str.maketrans('0123456789', '⁰¹²³⁴⁵⁶⁷⁸⁹'))}"


def limit_text(key: str) -> Callable[[Record], str]:
    """Text of the limit of a cost, the field ``limit_<key>``."""
    return lambda record: f"{record[f'limit_{key}']:g}" if f"limit_{key}" in record else MISSING


def plain(name: str) -> Callable[[Record], str]:
    """Text of a field as it is."""
    return lambda record: str(record.get(name, ""))
