"""Tables of a report: numbers for CSV, and what a reader sees as Markdown and HTML."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from safe_rl.extras import import_extra
from safe_rl.files import replace_text

__all__ = [
    *("MISSING", "SYMBOL", "Cell", "Column", "Record", "Table", "clean", "each_cost", "escaped"),
    *("interval", "mark_best", "power_of_ten", "span", "spread"),
]

MISSING = "—"
"""Shown where there is no value."""
SYMBOL = re.compile(r"\$(\\bar )?(\\rho|\w)(?:_(\w))?\$")
r"""A symbol in a title or a sentence, such as ``$\bar J_r$``."""
Record = Mapping[str, Any]


def clean(text: Any, most: int = 200) -> str:
    r"""Text as a page can show it: one line, printable, of bounded length.

    Examples:
        >>> clean("a\nb\x07"), clean("x" * 10, most=4)
        ('a b�', 'xxx…')
    """
    shown = "".join(c if c.isprintable() else " " if c.isspace() else "�" for c in str(text))
    return shown if len(shown) <= most else f"{shown[: most - 1]}…"


class Cell(NamedTuple):
    """What a reader sees of one entry; its mark is "best", "bad", or nothing."""

    title: str
    text: str
    mark: str
    is_number: bool


class Column:
    """A column: its head, and how the entry of a record is written.

    Args:
        title: Its head.
        parts: A template each, and the fields that fill it; a part is left out where one of its
            fields is missing or NaN, the entry where the first part is. Without any: the field
            ``title``.
        mark: Record -> "best" (bold), "bad" (over a limit), or nothing.

    Examples:
        >>> column = Column("x", *spread("x", 1))
        >>> column.text({"x": 1.25, "x_std": 0.5}), column.text({"x": 1.25}), column.text({})
        ('1.2 ± 0.5', '1.2', '—')
    """

    def __init__(
        self, title: str, *parts: tuple[str, ...], mark: Callable[[Record], str] | None = None
    ) -> None:
        self.title = title
        self.parts = parts or (("{}", title),)
        self.mark = mark or (lambda record: "")
        self.is_number = ":" in self.parts[0][0]

    def text(self, record: Record) -> str:
        """The entry of a record."""
        texts = [
            template.format(*(record[field] for field in fields))
            if all(_is_there(record.get(field)) for field in fields)
            else ""
            for template, *fields in self.parts
        ]
        return "".join(texts) if texts[0] else MISSING


def _is_there(value: Any) -> bool:
    return value is not None and not (isinstance(value, float) and math.isnan(value))


def spread(name: str, decimals: int) -> tuple[tuple[str, ...], ...]:
    """Parts of a column: a number, and ± its standard deviation, the field ``<name>_std``."""
    return (f"{{:.{decimals}f}}", name), (f" ± {{:.{decimals}f}}", f"{name}_std")


def interval(name: str, decimals: int) -> tuple[tuple[str, ...], ...]:
    """Parts of a column: an estimate, and the ends of its interval in brackets."""
    ends = f" [{{:.{decimals}f}}, {{:.{decimals}f}}]"
    return (f"{{:.{decimals}f}}", name), (ends, f"{name}_low", f"{name}_high")


def each_cost(
    keys: Sequence[str], fields: Mapping[str, str]
) -> Callable[[Record], Sequence[Record]]:
    """Show a record with figures of several costs as a row per cost.

    Args:
        keys: Keys of the costs.
        fields: Field of a row -> that of the record, with braces in place of the cost's key.

    Examples:
        >>> rows = each_cost(["a", "b", "c"], {"mean": "episode_{}"})
        >>> for row in rows({"seed": 0, "episode_a": 1.0, "episode_c": 3.0}):
        ...     print(row["seed"], row["of"], row["mean"])
        0 a 1.0
        0 c 3.0
    """

    def rows(record: Record) -> Sequence[Record]:
        shown: list[Record] = []
        for key in keys:
            places = {name: place.format(key) for name, place in fields.items()}
            own = {name: record[place] for name, place in places.items() if place in record}
            if own:
                shown.append({**record, "of": key, "named": clean(key, 40), **own})
        return shown or [record]

    return rows


@dataclass(frozen=True)
class Table:
    """Records, and how they are shown.

    Attributes:
        name: Stem of the file.
        title: Its heading.
        columns: What is shown.
        records: A row each as a rule; the CSV file holds all their fields, as numbers.
        note: Said below it.
        shown_as: The rows of a record, see :func:`each_cost`.

    Examples:
        >>> table = Table("t", "A table", [Column("x", ("{:.2f}", "x"))], [{"x": 1.23456}])
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
    shown_as: Callable[[Record], Sequence[Record]] = lambda record: [record]

    def rows(self) -> list[list[Cell]]:
        """What a reader sees."""
        return [
            [Cell(c.title, c.text(row), c.mark(row), c.is_number) for c in self.columns]
            for record in self.records
            for row in self.shown_as(record)
        ]

    def markdown(self) -> str:
        """The table in GitHub's Markdown; what is over its limit has a triangle."""
        looks = {"best": "**{}**", "bad": "{} ▲", "": "{}"}
        head = [escaped(column.title) for column in self.columns]
        rule = ["---:" if column.is_number else "---" for column in self.columns]
        rows = [[looks[cell.mark].format(escaped(cell.text)) for cell in r] for r in self.rows()]
        lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
        return "\n".join([lines[0], f"|{'|'.join(rule)}|", *lines[1:]])

    def write_csv(self, path: Path) -> None:
        """Write the records; what is not a number becomes an empty field."""
        pandas = import_extra("pandas", "report")
        rows = [{name: _field(v) for name, v in record.items()} for record in self.records]
        frame = pandas.DataFrame(rows, dtype=object)
        replace_text(path, frame.to_csv(index=False, lineterminator="\n"))


def _field(value: Any) -> Any:
    # a spreadsheet would take such a text for a formula
    return f"'{value}" if isinstance(value, str) and value[:1] in {*"=+-@"} else value


def escaped(text: str) -> str:
    r"""Text as Markdown shows it, symbols aside.

    Examples:
        >>> print(escaped("<b> a|b $x_y$"))
        \<b\> a\|b $x_y$
    """
    special = rf"({SYMBOL.pattern})|[\\`*_{{}}\[\]<>|#$~&]"
    return re.sub(special, lambda match: match[0] if match[1] else rf"\{match[0]}", text)


def mark_best(
    records: Sequence[Record],
    name: str,
    best: Callable[..., float],
    *,
    is_able: Callable[[Record], bool],
    rivals: Callable[[Record], Hashable],
) -> Callable[[Record], str]:
    """Mark the best value of a column, and all equal to it, among records that are comparable.

    Args:
        records: Rows of the table.
        name: Field of the value.
        best: ``max`` or ``min``.
        is_able: Which of them can be the best.
        rivals: What is equal in records that can be compared; a record without any is not marked.

    Examples:
        >>> rows = [{"x": x, "steps": steps} for x, steps in ((1, 5), (2, 5), (2, 5), (9, 6))]
        >>> mark = mark_best(rows, "x", max, is_able=lambda r: True, rivals=lambda r: r["steps"])
        >>> [mark(row) for row in rows]
        ['', 'best', 'best', '']
    """

    def mark(record: Record) -> str:
        group = [other for other in records if rivals(other) == rivals(record)]
        if len(group) < 2 or name not in record or not is_able(record):
            return ""
        known = [r[name] for r in group if is_able(r) and _is_there(r.get(name))]
        return "best" if known and math.isclose(record[name], best(known), rel_tol=1e-9) else ""

    return mark


def span(numbers: Sequence[int]) -> str:
    """From the lowest to the highest of some numbers.

    Examples:
        >>> span([3000, 1000]), span([1000, 1000])
        ('1,000 to 3,000', '1,000')
    """
    lowest, highest = min(numbers), max(numbers)
    return f"{lowest:,}" if lowest == highest else f"{lowest:,} to {highest:,}"


def power_of_ten(value: int) -> str:
    """A power of ten as people write it.

    Examples:
        >>> power_of_ten(10_000_000)
        '10⁷'
    """
    return f"10{str(round(math.log10(value))).translate(str.maketrans('0123456789', '⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
