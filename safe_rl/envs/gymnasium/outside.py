"""Costs of environments that report none: a number of the observation has to stay in a range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from safe_rl.envs.costs import check_range
from safe_rl.envs.errors import ConfigError

__all__ = ["CostsOutside", "check_outside"]

Ranges = Mapping[str, Sequence[float]]


class CostsOutside(gymnasium.Wrapper):
    """Costs 1 in `info` for every step after which a number of the observation is out of its range.

    Args:
        env: the environment.
        outside: name of the cost -> column of the flattened observation, lowest and highest number
            that cost nothing.

    Examples:
        >>> env = CostsOutside(gymnasium.make("CartPole-v1"), {"cost_position": [0, -0.5, 0.5]})
        >>> _ = env.reset(seed=0)
        >>> env.step(0)[-1]
        {'cost_position': 0.0}
    """

    def __init__(self, env: gymnasium.Env, outside: Ranges) -> None:
        super().__init__(env)
        self._ranges = {
            key: (int(column), low, high) for key, (column, low, high) in outside.items()
        }
        size = gymnasium.spaces.flatdim(env.observation_space)
        for key, (column, _, _) in self._ranges.items():
            if column >= size:
                raise ValueError(
                    f"outside: {key} is of column {column}, but the observation has {size}, "
                    "counted from 0."
                )

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and look at what is observed then."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        flat = np.asarray(gymnasium.spaces.flatten(self.env.observation_space, observation))
        costs = {
            key: float(not low <= flat[column] <= high)
            for key, (column, low, high) in self._ranges.items()
        }
        return observation, reward, terminated, truncated, {**info, **costs}


def check_outside(outside: Any) -> None:
    """Refuse what is no mapping from names of costs to a column, a lowest and a highest number.

    Raises:
        ConfigError: naming the entry.

    Examples:
        >>> check_outside({"cost_position": [0, -0.5, 0.5]})
    """
    form = "'{cost_position: [0, -0.5, 0.5]}': column of the observation, lowest, highest"
    if not isinstance(outside, Mapping):
        raise ConfigError(f"'outside' must be as {form}; got {outside!r}.")
    for key, row in outside.items():
        numbers = isinstance(row, Sequence) and all(isinstance(x, int | float) for x in row)
        if not numbers or len(row) != 3 or row[0] % 1 or row[0] < 0:
            raise ConfigError(f"'outside' must be as {form}; got {key}: {row!r}.")
        check_range(key, row[1], row[2])
