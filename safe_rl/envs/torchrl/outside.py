"""Costs of leaving a range: one number of an entry has to stay between two others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from safe_rl.envs.costs import check_range
from safe_rl.envs.errors import ConfigError

_FORM = (
    "'{cost_speed: [thdot, -4, 4]}': entry, lowest, highest; of an entry with several numbers "
    "[observation, 2, -4, 4], with the column"
)


class Range(NamedTuple):
    """What costs nothing.

    Attributes:
        entry: name of an entry, with dots where it is nested.
        column: of the entry's numbers, counted from 0.
        low: lowest number that costs nothing.
        high: highest one.
    """

    entry: str
    column: int
    low: float
    high: float


def parse_outside(outside: Any) -> dict[str, Range]:
    """Return ranges by the name of their cost.

    Raises:
        ConfigError: naming the entry that is not as it should be.

    Examples:
        >>> parse_outside({"cost_speed": ["thdot", -4, 4]})
        {'cost_speed': Range(entry='thdot', column=0, low=-4, high=4)}
    """
    if not isinstance(outside, Mapping):
        raise ConfigError(f"'outside' must be as {_FORM}; got {outside!r}.")
    return {str(key): _range(key, row) for key, row in outside.items()}


def _range(key: Any, row: Any) -> Range:
    if not isinstance(row, list | tuple) or len(row) not in (3, 4) or not isinstance(row[0], str):
        raise ConfigError(f"'outside' must be as {_FORM}; got {key}: {row!r}.")
    column, low, high = (0, *row[1:]) if len(row) == 3 else row[1:]
    if not all(map(_is_number, (column, low, high))) or column % 1 or column < 0:
        raise ConfigError(f"'outside' must be as {_FORM}; got {key}: {row!r}.")
    check_range(key, low, high)
    return Range(row[0], int(column), low, high)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
