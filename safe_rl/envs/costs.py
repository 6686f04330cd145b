"""Names of costs, and costs of leaving a range: what families that make them have in common."""

from __future__ import annotations

import math
from typing import Any

from safe_rl.envs.errors import ConfigError

COST = "cost"


def is_cost(name: Any) -> bool:
    """Whether a name is one of a cost: `cost` or `cost_<kind>`."""
    return name == COST or str(name).startswith(f"{COST}_")


def check_range(key: Any, low: float, high: float) -> None:
    """Refuse a range of `outside` that nothing leaves, or nothing keeps, or that is no cost's.

    Raises:
        ConfigError: naming the key.

    Examples:
        >>> check_range("cost_speed", -4.0, 4.0)
    """
    if not low <= high or not any(map(math.isfinite, (low, high))):
        raise ConfigError(f"'outside': {key} has the range {low} to {high}.")
    if not is_cost(key):
        raise ConfigError(f"'outside': costs are called cost or cost_<kind>, not '{key}'.")
