"""Tables of a report: records for CSV, rows for HTML and LaTeX, records of notes of runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.ticker import EngFormatter

from safe_rl.extras import import_extra
from safe_rl.files import replace_text
from safe_rl.runs.folder import checkpoint_steps

Record = Mapping[str, Any]
_LATEX = str.maketrans(
    {character: rf"\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"±": r"$\pm$", "≤": r"$\leq$", "…": r"\dots{}", "—": "--", "\N{NO-BREAK SPACE}": "~"}
)
short_number = EngFormatter(sep="")
"""Formats a number of steps briefly, such as 1.5M."""


def clean(text: Any, most: int = 200) -> str:
    r"""A text that a page can show: one line, printable, of bounded length.

    Examples:
        >>> clean("a\nb\x07"), clean("x" * 10, most=4)
        ('a b�', 'xxx…')
    """
    kept = "\N{NO-BREAK SPACE}"
    shown = "".join(
        c if c.isprintable() or c == kept else " " if c.isspace() else "�" for c in str(text)
    )
    return shown if len(shown) <= most else f"{shown[: most - 1]}…"


def spread(name: str, decimals: int) -> str:
    """Template of a mean and the standard deviation over seeds, see `filled`."""
    return f"{{{name}:.{decimals}f}}|\N{NO-BREAK SPACE}± {{{name}_std:.{decimals}f}}"


def interval(name: str, decimals: int) -> str:
    """Template of an estimate and the bounds of its interval, see `filled`."""
    form = f".{decimals}f"
    return f"{{{name}:{form}}}| [{{{name}_low:{form}}}, {{{name}_high:{form}}}]"


def filled(template: str, record: Record) -> str:
    """Fill a template with the fields of a record.

    The parts of a template are separated by ``|``. A part is left out if one of its fields is
    missing or NaN. If that is the first part, the result is a dash.

    Examples:
        >>> filled("{x:.1f}| ± {x_std:.1f}", {"x": 1.25}), filled("{x:.1f}", {"y": 1})
        ('1.2', '—')
    """
    known = {name: value for name, value in record.items() if not _is_missing(value)}
    first, *others = template.split("|")
    try:
        text = first.format_map(known)
    except KeyError:
        return "—"
    for part in others:
        with suppress(KeyError):
            text += part.format_map(known)
    return text


def _is_missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))


def each_cost(
    records: Sequence[dict[str, Any]], keys: Sequence[str], **fields: str
) -> list[dict[str, Any]]:
    """A row for every cost of every record; a record without figures of costs is one row.

    ``fields``: field of a row -> field of the record, with braces in place of the cost's key.

    Examples:
        >>> each_cost([{"seed": 0, "rate_a": 1.0}], ["a", "b"], rate="rate_{}")
        [{'seed': 0, 'rate_a': 1.0, 'key': 'a', 'cost': 'a', 'rate': 1.0}]
    """
    rows = []
    for record in records:
        of_record = []
        for key in keys:
            places = {name: place.format(key) for name, place in fields.items()}
            if figures := {name: record[p] for name, p in places.items() if p in record}:
                of_record.append({**record, "key": key, "cost": clean(key, 40), **figures})
        rows += of_record or [record]
    return rows


class Cell(NamedTuple):
    """The text of one entry and its mark, which is "best", "bad" or ""."""

    text: str
    mark: str


@dataclass(frozen=True)
class Table:
    """Records, and how they are shown.

    Attributes:
        name: Stem of the CSV file.
        title: Its heading.
        columns: Title of a column -> template, see `filled`.
        records: Records, all fields of which are in the CSV file, as numbers.
        note: Text below the table.
        shown: Records that the page shows; None: ``records``.
        marks: Title of a column -> function from a record to "best" (bold), "bad" (over a limit),
            or "".

    Examples:
        >>> table = Table("t", "A table", {"x": "{x:.2f}"}, [{"x": 1.23456}])
        >>> table.rows()
        [[Cell(text='1.23', mark='')]]
    """

    name: str
    title: str
    columns: Mapping[str, str]
    records: Sequence[Record]
    note: str = ""
    shown: Sequence[Record] | None = None
    marks: Mapping[str, Callable[[Record], str]] = field(default_factory=dict)

    @property
    def numbers(self) -> list[bool]:
        """Whether each column has numbers: then the first field of its template has a format."""
        return [":" in template.partition("}")[0] for template in self.columns.values()]

    def rows(self) -> list[list[Cell]]:
        """The entries that the page shows."""
        return [
            [
                Cell(clean(filled(text, row), 1000), self.marks.get(title, lambda _: "")(row))
                for title, text in self.columns.items()
            ]
            for row in (self.records if self.shown is None else self.shown)
        ]

    def latex(self) -> str:
        """The table in LaTeX, for the package booktabs; a triangle marks costs over their limit."""
        looks = {"best": r"\textbf{{{}}}", "bad": r"{} $\triangle$", "": "{}"}
        cells = [[looks[c.mark].format(c.text.translate(_LATEX)) for c in r] for r in self.rows()]
        frame = import_extra("pandas", "report").DataFrame(cells, columns=list(self.columns))
        sides = "".join("r" if is_number else "l" for is_number in self.numbers)
        text: str = frame.to_latex(index=False, escape=False, column_format=sides)
        return f"% {clean(self.title)}\n{text}"

    def write_csv(self, path: Path) -> None:
        """Write the records as CSV; NaN and missing values become empty fields."""
        # a spreadsheet would take a text with such a beginning for a formula
        risky = lambda value: isinstance(value, str) and value[:1] in {*"=+-@\t\r"}  # noqa: E731
        rows = [{k: f"'{v}" if risky(v) else v for k, v in r.items()} for r in self.records]
        frame = import_extra("pandas", "report").DataFrame(rows, dtype=object)
        replace_text(path, frame.to_csv(index=False, lineterminator="\n"))


def mark_best(
    records: Sequence[Record],
    name: str,
    best: Callable[..., float],
    is_able: Callable[[Record], bool],
    rivals: Mapping[str, Any],
) -> Callable[[Record], str]:
    """Return a function that marks the best value of a column, and values equal to it.

    The best is the ``best`` (``max`` or ``min``) among records for which ``is_able`` holds and
    whose algorithms have equal ``rivals``. A record without rivals is not marked.
    """

    def mark(record: Record) -> str:
        group = [r for r in records if rivals[r["algorithm"]] == rivals[record["algorithm"]]]
        known = [r[name] for r in group if is_able(r) and not _is_missing(r.get(name))]
        is_ranked = len(group) > 1 and is_able(record) and bool(known)
        value = record.get(name, math.nan)
        return "best" if is_ranked and math.isclose(value, best(known)) else ""

    return mark


def read_certificate(content: Mapping[str, Any]) -> dict[str, Any]:
    """A certificate as a record of tables; any exception if the content is no certificate.

    Its ``checkpoint`` is the number of steps, or None if no policy is certified. ``bound_<name>``
    is the upper bound on a mean, and ``most_<name>`` its limit. It is "by construction" if no
    episode can cost more than the limits; ``test`` is the kind of the bounds.
    """
    checkpoint, bounds = content["checkpoint"], content["bounds"]
    highest = content.get("highest") or {}
    # those of earlier versions are by the name of the bound
    most = {name: highest.get(name, highest.get(name.partition("_")[2])) for name in bounds}
    is_sure = all(m is not None and m <= bounds[name]["most"] for name, m in most.items())
    certified = "by construction" if is_sure else "yes"
    # before there were two kinds, it was Student's, which is too low if rare episodes cost much
    kind = {"betting": "betting", "student": "Student"}[content.get("bound", "student")]
    return {
        "certified": "no" if checkpoint is None else certified,
        "surely": None if is_sure else f"{100 * content['level']:.12g}%",  # not rounded up to 100
        "checkpoint": None if checkpoint is None else checkpoint_steps(Path(str(checkpoint))),
        "certified_return": _number(content["episode_return"]),
        "episodes": int(content["episodes"]),
        "level": float(content["level"]),
        **{f"bound_{name}": _number(bound["bound"]) for name, bound in bounds.items()},
        **{f"most_{name}": _number(bound["most"]) for name, bound in bounds.items()},
        "test": kind,
        "actions": "mean" if content.get("deterministic") else "sampled",
    }


def read_evaluation(content: Mapping[str, Any]) -> dict[str, Any]:
    """An evaluation as a record of tables: every estimate and the bounds of its interval."""
    manner = [str(content["name"])] if content.get("name") else []
    manner.append("mean actions" if content["deterministic"] else "sampled actions")
    manner += [f"{key}={value}" for key, value in content["env"].items()]
    manner.append(f"{content['layouts_trained_on']:.0%} known layouts")
    record = {
        "checkpoint": clean(content["checkpoint"]),
        "steps": content["steps"],
        "episodes": int(content["episodes"]),
        "cvar_alpha": float(content["cvar_alpha"]),
        "manner": clean(", ".join(manner)),
        **{f"limit_{key}": float(d) for key, d in content["cost_limits"].items()},
    }
    for name, estimate in content["estimates"].items():
        for part, suffix in (("value", ""), ("low", "_low"), ("high", "_high")):
            record[f"{name}{suffix}"] = _number(estimate[part])
    return record


def read_code(content: Sequence[Mapping[str, Any]]) -> str:
    """The version of a run's code, and commits, also of the user's modules.

    Of later ones also the steps at which they began.
    """
    parts = []
    for entry in content[:9]:
        words = [clean(entry["version"], 20)]
        for name, code in {"": entry, **entry.get("imports", {})}.items():
            words += [clean(name), clean(code["commit"] or "")[:10]]
            words += ["with changes"] if code["changed"] else []
        words += [f"from {int(entry['steps']):,} steps on"] if entry["steps"] else []
        parts.append(" ".join(filter(None, words)))
    return "; ".join(parts)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
