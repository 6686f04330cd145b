"""A run's table: a CSV file with a row per epoch."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from safe_rl.files import read_bounded, replace_text

# largest size of a table [bytes]; ten thousand epochs with a hundred columns have about 20 million
MOST_BYTES = 100_000_000
_MOST_COLUMNS = 10_000


class TableError(ValueError):
    """A table that is not as its run has written it."""


class TableWriter(AbstractContextManager["TableWriter"]):
    """Append rows of numbers to a CSV file; the first row fixes the columns.

    Every row is flushed. NaN becomes an empty field. Numbers are written so that they read back
    exactly, whole ones without a decimal point.

    Args:
        path: File to write. An existing one is replaced.
        keep_rows: Number of rows of an existing file to keep, for a run that continues.

    Raises:
        TableError: If there are fewer rows than are to be kept, or one cannot be read; from
            `write`, if a row's columns differ from those of the first row.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "progress.csv"
        >>> with TableWriter(path) as table:
        ...     table.write({"epoch": 1, "episode_return": math.nan})
        ...     table.write({"epoch": 2, "episode_return": 0.5})
        >>> read_table(path)["episode_return"]
        [nan, 0.5]
    """

    def __init__(self, path: Path, keep_rows: int = 0) -> None:
        kept = _first_rows(path, keep_rows) if keep_rows else []
        _columns_of(path, kept)
        self._columns = next(csv.reader(kept)) if kept else None
        # replaced atomically: a run killed here still has its table
        replace_text(path, "".join(kept))
        self._file = path.open("a", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")

    def write(self, row: Mapping[str, float]) -> None:
        """Append a row."""
        if self._columns is None:
            self._columns = list(row)
            self._append(self._columns)
        if list(row) != self._columns:
            unexpected = sorted(set(row).symmetric_difference(self._columns))
            raise TableError(
                f"Every row of progress.csv must have the columns of the first, in the same order; "
                f"these are in one of the two only: {unexpected}. If the file has been changed, "
                "restore it; report a diagnostic in every epoch, as NaN where it does not exist."
            )
        self._append([_field(value) for value in row.values()])

    def _append(self, fields: Sequence[str]) -> None:
        self._writer.writerow(fields)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __exit__(self, *exception: object) -> None:
        self.close()


def _first_rows(path: Path, number: int) -> list[str]:
    """Lines of a table: the header and the first ``number`` rows."""
    complete = _complete_lines(path) if path.exists() else []
    if len(complete) < number + 1:
        raise TableError(
            f"{path} holds {max(0, len(complete) - 1)} complete rows, but the run that is to be "
            f"continued has finished {number} epochs: the table has been changed or cut off. "
            "Restore it to continue, or begin a new run from the networks with init_from=."
        )
    return complete[: number + 1]


def _complete_lines(path: Path) -> list[str]:
    """Lines of a table without the last one if its end is still missing."""
    try:
        lines = read_bounded(path, MOST_BYTES).decode().splitlines(keepends=True)
    except UnicodeDecodeError:
        raise TableError(f"{path} is no table: it is not text.") from None
    return [line for line in lines if line.endswith("\n")]


def _field(value: float) -> str:
    if math.isnan(value):
        return ""
    return str(int(value)) if float(value).is_integer() else repr(float(value))


def _columns_of(path: Path, lines: Sequence[str]) -> dict[str, list[float]]:
    """Numbers of a table by columns.

    Raises:
        TableError: If a row has more or fewer fields than the header, or a field is no number.
    """
    names, *rows = csv.reader(lines) if lines else [[]]
    if len(names) > _MOST_COLUMNS:
        raise TableError(f"{path} has {len(names):,} columns, more than any run writes.")
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise TableError(
                f"{path}, line {number} has {len(row)} fields and the header {len(names)}: the "
                "table has been changed. Restore it."
            )
    try:
        columns = zip(*rows, strict=True) if rows else ([] for _ in names)
        return {name: list(map(_number, c)) for name, c in zip(names, columns, strict=True)}
    except ValueError as error:
        raise TableError(f"{path} has a field that is no number: {error}.") from None


def _number(field: str) -> float:
    # always the same NaN object: tables with equal numbers are equal
    return float(field) if field else math.nan


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
