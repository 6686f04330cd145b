"""Wrappers that convert observations, actions and costs of single Gymnasium environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from gymnasium.wrappers import TimeLimit, TransformAction, TransformObservation

from safe_rl.envs.costs import COST
from safe_rl.envs.errors import ConfigError

COST_SUM = "cost_sum"  # Safety-Gymnasium's name for the sum of all kinds


def make_adapted(
    make: Callable[[], gymnasium.Env], num_steps: int, flatten: bool, cost_keys: Sequence[str]
) -> gymnasium.Env:
    """Make an environment whose choices start at 0 and whose costs are floats.

    Args:
        make: Makes the environment.
        num_steps: Steps after which its episodes are truncated.
        flatten: Whether the observation becomes one float32 vector.
        cost_keys: Names of the costs in `info`.
    """
    env = make()
    seen, actions = env.observation_space, env.action_space
    # Gymnasium's own wrapper, FlattenObservation, contains lambdas and cannot be pickled.
    if flatten:
        space = Box(-np.inf, np.inf, (gymnasium.spaces.flatdim(seen),), np.float32)
        env = TransformObservation(env, partial(_vector, seen), space)
    if isinstance(actions, Discrete | MultiDiscrete) and np.any(actions.start):
        choices = (
            Discrete(actions.n) if isinstance(actions, Discrete) else MultiDiscrete(actions.nvec)
        )
        env = TransformAction(env, partial(np.add, actions.start), choices)
    return FloatCosts(TimeLimit(env, num_steps), cost_keys)


def _vector(space: gymnasium.Space, observation: Any) -> np.ndarray:
    return np.asarray(gymnasium.spaces.flatten(space, observation)).astype(np.float32)


class FloatCosts(gymnasium.Wrapper):
    """Converts the costs in `info` to floats; ConfigError if one is not a number.

    Gymnasium puts the costs of a batch into an array of the first row's type. If this is an
    integer, it rounds the costs of the other rows.
    """

    def __init__(self, env: gymnasium.Env, cost_keys: Sequence[str]) -> None:
        super().__init__(env)
        self._cost_keys = list(cost_keys)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and convert the costs."""
        *values, info = self.env.step(action)
        costs = {key: info[key] for key in self._cost_keys if key in info}
        for key, cost in costs.items():
            try:
                costs[key] = float(cost)
            except (TypeError, ValueError):
                raise ConfigError(
                    f"info['{key}'] must be one number per step, as it is a cost; got {cost!r}."
                ) from None
        return *values, {**info, **costs}


class SixValues(gymnasium.Wrapper):
    """An environment whose step returns (observation, reward, cost, terminated, truncated, info).

    The wrapper's step returns Gymnasium's five values, with the cost in `info`.
    """

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take an action; ValueError if the environment returns another number of values."""
        values: tuple[Any, ...] = self.env.step(action)
        if len(values) != 6:
            raise ValueError(
                f"A step of {self.env} returned {len(values)} values instead of six (observation, "
                "reward, cost, terminated, truncated, info). For an environment that returns five "
                "values and has the cost in info, use env=gymnasium."
            )
        observation, reward, cost, terminated, truncated, info = values
        others = {key: value for key, value in info.items() if key != COST_SUM}
        return observation, reward, terminated, truncated, {**others, COST: float(cost)}
