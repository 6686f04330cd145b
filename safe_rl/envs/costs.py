"""Names of costs, and ranges that cost something to leave: what foreign families have in common."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from safe_rl.envs.errors import ConfigError

COST = "cost"
_COLUMN_FORM = "'{cost_position: [0, -0.5, 0.5]}': column of the observation, lowest, highest"
_ENTRY_FORM = (
    "'{cost_speed: [thdot, -4, 4]}': entry, lowest, highest; of an entry with several numbers "
    "[observation, 2, -4, 4], with the column"
)


class CostRange(NamedTuple):
    """The numbers that cost nothing.

    Attributes:
        entry: Name of an entry, with dots where it is nested.
        column: Column of the entry's numbers, counted from 0.
        low: Lowest number that costs nothing.
        high: Highest one.
    """

    entry: str
    column: int
    low: float
    high: float


def is_cost(name: Any) -> bool:
    """Whether a name is one of a cost: `cost` or `cost_<kind>`."""
    return name == COST or str(name).startswith(f"{COST}_")


def parse_columns(key: str, outside: Any) -> dict[str, CostRange]:
    """Return ranges of columns of the observation, by the name of their cost.

    Args:
        key: The key that holds them, for messages.
        outside: Name -> (column, lowest, highest); None is no range at all.

    Raises:
        ConfigError: Naming what is wrong.

    Examples:
        >>> parse_columns("outside", {"cost_position": [0, -0.5, 0.5]})
        {'cost_position': CostRange(entry='observation', column=0, low=-0.5, high=0.5)}
    """
    rows = _rows(key, outside, _COLUMN_FORM)
    return {
        name: _range(key, name, ["observation", *row], row, _COLUMN_FORM)
        for name, row in rows.items()
    }


def parse_entries(key: str, outside: Any) -> dict[str, CostRange]:
    """Return ranges of entries by the name of their cost, as :func:`parse_columns`.

    Args:
        key: The key that holds them, for messages.
        outside: Name -> (entry, lowest, highest) or (entry, column, lowest, highest), or None.

    Raises:
        ConfigError: Naming what is wrong.

    Examples:
        >>> parse_entries("outside", {"cost_speed": ["thdot", -4, 4]})
        {'cost_speed': CostRange(entry='thdot', column=0, low=-4, high=4)}
    """
    rows = _rows(key, outside, _ENTRY_FORM)
    return {
        name: _range(key, name, [row[0], 0, *row[1:]] if len(row) == 3 else row, row, _ENTRY_FORM)
        for name, row in rows.items()
    }


def _rows(key: str, outside: Any, form: str) -> dict[str, list[Any]]:
    if outside is not None and not isinstance(outside, Mapping):
        raise ConfigError(f"'{key}' must be as {form}; got {outside!r}.")
    rows = {str(name): row for name, row in (outside or {}).items()}
    for name, row in rows.items():
        if not isinstance(row, list | tuple) or not row:
            raise ConfigError(f"'{key}' must be as {form}; got {name}: {row!r}.")
    return {name: list(row) for name, row in rows.items()}


def _range(key: str, name: str, full: list[Any], given: list[Any], form: str) -> CostRange:
    entry, *numbers = full
    are_numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)
    if not isinstance(entry, str) or len(numbers) != 3 or not are_numbers:
        raise ConfigError(f"'{key}' must be as {form}; got {name}: {given!r}.")
    column, low, high = numbers
    if column % 1 or column < 0:
        raise ConfigError(f"'{key}' must be as {form}; got {name}: {given!r}.")
    if not low <= high or not any(map(math.isfinite, (low, high))):
        raise ConfigError(f"'{key}': {name} has the range {low} to {high}.")
    if not is_cost(name):
        raise ConfigError(f"'{key}': costs are called cost or cost_<kind>, not '{name}'.")
    return CostRange(entry, int(column), low, high)
