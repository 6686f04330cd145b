"""Names of costs, and costs for leaving a range."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from safe_rl.envs.errors import ConfigError

COST = "cost"
_FORM = (
    "'{cost_speed: [2, -4, 4]}' (column of the observation, lowest, highest), or for another entry "
    "[thdot, -4, 4], or with its column [thdot, 0, -4, 4]"
)


class CostRange(NamedTuple):
    """A range of values without a cost; values outside it have a cost.

    Attributes:
        entry: Name of the entry, with dots where it is nested.
        column: Column of the entry, counted from 0.
        low: Lowest value without a cost.
        high: Highest value without a cost.
    """

    entry: str
    column: int
    low: float
    high: float


def is_cost(name: Any) -> bool:
    """Whether a name is that of a cost: `cost` or `cost_<kind>`."""
    return name == COST or str(name).startswith(f"{COST}_")


def parse_ranges(outside: Any) -> dict[str, CostRange]:
    """Return the ranges of the configuration key `outside`, by the names of their costs.

    Args:
        outside: Name -> (entry, column, lowest, highest). The default entry is the observation. The
            default column of another entry is the first one. None means no ranges.

    Raises:
        ConfigError: If a name, the form of a range or its bounds are wrong.

    Examples:
        >>> parse_ranges({"cost_speed": ["thdot", -4, 4]})
        {'cost_speed': CostRange(entry='thdot', column=0, low=-4, high=4)}
    """
    if outside is not None and not isinstance(outside, Mapping):
        raise ConfigError(f"'outside' must have the form {_FORM}; got {outside!r}.")
    ranges = {}
    for name, row in (outside or {}).items():
        full = list(row) if isinstance(row, list | tuple) else []
        if len(full) == 3:
            full = [full[0], 0, *full[1:]] if isinstance(full[0], str) else ["observation", *full]
        if not _is_range(full):
            raise ConfigError(f"'outside' must have the form {_FORM}; got {name}: {row!r}.")
        kept = CostRange(full[0], int(full[1]), *full[2:])
        if not kept.low <= kept.high or (math.isinf(kept.low) and math.isinf(kept.high)):
            raise ConfigError(f"'outside': {name} cannot have the range {kept.low} to {kept.high}.")
        if not is_cost(name):
            raise ConfigError(f"'outside': costs are called cost or cost_<kind>, not '{name}'.")
        ranges[name] = kept
    return ranges


def _is_range(row: list[Any]) -> bool:
    """Whether a row is an entry, a column and two numbers."""
    numbers = row[1:]
    are_numbers = all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)
    if len(row) != 4 or not isinstance(row[0], str) or not are_numbers:
        return False
    return numbers[0] >= 0 and numbers[0] % 1 == 0
