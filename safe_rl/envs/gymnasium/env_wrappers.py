"""Wrappers of single Gymnasium environments: spaces as policies take them, costs in `info`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete
from gymnasium.wrappers import TransformAction, TransformObservation

from safe_rl.envs.costs import COST, CostRange

COST_SUM = "cost_sum"  # Safety-Gymnasium's name for the sum of all kinds


def make_adapted(
    make: Callable[[], gymnasium.Env], num_steps: int, flatten: bool, cost_keys: Sequence[str]
) -> gymnasium.Env:
    """Make an environment, :func:`adapt` it, and have its costs reported as floats."""
    return FloatCosts(adapt(make(), num_steps, flatten=flatten), cost_keys)


def adapt(
    env: gymnasium.Env, num_steps: int | None = None, *, flatten: bool = True
) -> gymnasium.Env:
    """Wrap an environment: float32 vectors and pictures, actions in [-1, 1] or choices from 0.

    Args:
        env: The environment.
        num_steps: Truncate episodes after that many steps; None leaves their length alone.
        flatten: Make one vector of the observation; False leaves pictures and dictionaries.

    Raises:
        ValueError: For actions or observations that policies cannot have.
    """
    env = _flat(env) if flatten else _by_entry(env)
    env = _with_plain_actions(env)
    return env if num_steps is None else gymnasium.wrappers.TimeLimit(env, num_steps)


class FloatCosts(gymnasium.Wrapper):
    """Makes the costs in `info` floats; what is no single number stays as it is.

    Gymnasium puts the costs of a batch into an array of the type of the first row, and rounds.
    """

    def __init__(self, env: gymnasium.Env, cost_keys: Sequence[str]) -> None:
        super().__init__(env)
        self._cost_keys = list(cost_keys)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and convert what is reported."""
        *values, info = self.env.step(action)
        costs = {
            key: float(info[key])
            for key in self._cost_keys
            if isinstance(info.get(key), bool | int | float | np.number | np.bool_)
        }
        return *values, {**info, **costs}


class CostsOutside(gymnasium.Wrapper):
    """Costs 1 in `info` for every step after which a number of the observation is out of its range.

    Args:
        env: The environment.
        ranges: Name of the cost -> range of a column of the flattened observation.
    """

    def __init__(self, env: gymnasium.Env, ranges: dict[str, CostRange]) -> None:
        super().__init__(env)
        self._ranges = ranges
        size = gymnasium.spaces.flatdim(env.observation_space)
        for key, kept in ranges.items():
            if kept.column >= size:
                raise ValueError(
                    f"outside: {key} is of column {kept.column}, but the observation has {size}, "
                    "counted from 0."
                )

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and compare the observation with the ranges."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        flat = np.asarray(gymnasium.spaces.flatten(self.env.observation_space, observation))
        costs = {
            key: float(not kept.low <= flat[kept.column] <= kept.high)
            for key, kept in self._ranges.items()
        }
        return observation, reward, terminated, truncated, {**info, **costs}


class SixValues(gymnasium.Wrapper):
    """An environment whose step returns (observation, reward, cost, terminated, truncated, info).

    Here its step returns Gymnasium's five values, and the cost is in `info`.

    Examples:
        >>> class Slide(gymnasium.Env):
        ...     observation_space = gymnasium.spaces.Box(-1, 1, (1,))
        ...     action_space = gymnasium.spaces.Box(-1, 1, (1,))
        ...     def step(self, action):
        ...         return action, 1.0, float(action[0] > 0), False, False, {"cost_ice": 0.0}
        >>> SixValues(Slide()).step([0.5])[-1]
        {'cost_ice': 0.0, 'cost': 1.0}
    """

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take an action; ValueError if the environment returns another number of values."""
        values: tuple[Any, ...] = self.env.step(action)
        if len(values) != 6:
            raise ValueError(
                f"A step of {self.env} returned {len(values)} values instead of six (observation, "
                "reward, cost, terminated, truncated, info). Five with the cost in info are for "
                "env=gymnasium."
            )
        observation, reward, cost, terminated, truncated, info = values
        others = {key: value for key, value in info.items() if key != COST_SUM}
        return observation, reward, terminated, truncated, {**others, COST: float(cost)}


# Not by the wrappers that Gymnasium has for these: they keep lambdas, which cannot be pickled.
def _flat(env: gymnasium.Env) -> gymnasium.Env:
    space = env.observation_space
    return TransformObservation(env, partial(_vector, space), _vectors(space))


def _vectors(space: gymnasium.Space) -> Box:
    return Box(-np.inf, np.inf, (gymnasium.spaces.flatdim(space),), np.float32)


def _vector(space: gymnasium.Space, observation: Any) -> np.ndarray:
    return np.asarray(gymnasium.spaces.flatten(space, observation)).astype(np.float32)


def _by_entry(env: gymnasium.Env) -> gymnasium.Env:
    space = env.observation_space
    if isinstance(space, Dict):
        entries = {n: p if _is_picture(p) else _vectors(p) for n, p in space.items()}
        nested = Dict({"observation": Dict(entries)})
        return TransformObservation(env, partial(_entries, space), nested)
    if not isinstance(space, Box):
        raise ValueError(
            "Policies take observations that are arrays (a Box) or dictionaries, but "
            f"{env.unwrapped} has {space}. flatten=true makes one vector of it: kinds (Discrete) "
            "become one-hot."
        )
    return env if _is_picture(space) else _flat(env)


def _is_picture(space: gymnasium.Space) -> bool:
    return isinstance(space, Box) and len(space.shape) == 3


def _entries(space: Dict, observation: dict[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """Pictures as they are, all others as vectors, below one name."""
    entries = {
        name: observation[name] if _is_picture(part) else _vector(part, observation[name])
        for name, part in space.items()
    }
    return {"observation": entries}


def _with_plain_actions(env: gymnasium.Env) -> gymnasium.Env:
    """Let policies act in [-1, 1], or choose from 0."""
    actions, plain = env.action_space, _plain_actions(env)
    if isinstance(actions, Box):
        return TransformAction(env, partial(stretch, actions), plain)
    start = actions.start if isinstance(actions, Discrete | MultiDiscrete) else 0
    return TransformAction(env, partial(np.add, start), plain) if np.any(start) else env


def _plain_actions(env: gymnasium.Env) -> gymnasium.Space:
    actions = env.action_space
    is_real = isinstance(actions, Box) and np.issubdtype(actions.dtype, np.floating)
    if isinstance(actions, Box) and is_real and actions.is_bounded():
        return Box(-1.0, 1.0, actions.shape, actions.dtype.type)
    if isinstance(actions, Discrete):
        return Discrete(int(actions.n))
    if isinstance(actions, MultiDiscrete) and actions.nvec.ndim == 1:
        return MultiDiscrete(actions.nvec)
    raise ValueError(
        "The algorithms need actions that are continuous and bounded (a Box) or choices "
        f"(Discrete, MultiDiscrete), but {env.unwrapped} has {actions}."
    )


def stretch(space: Box, action: np.ndarray) -> np.ndarray:
    """Map actions from [-1, 1] to the bounds of a space; clip those beyond."""
    middle, half = space.high / 2 + space.low / 2, space.high / 2 - space.low / 2
    return np.clip(middle + half * action, space.low, space.high)
