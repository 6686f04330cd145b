"""Gymnasium's environments as networks and tables take them: their spaces, and costs as floats.

Observations become vectors and pictures, actions lie in [-1, 1] or are choices. Processes that step
environments import this, and by themselves no torch: they start in a second, and are small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete

__all__ = ["FloatCosts", "adapt", "check_workers", "make_adapted"]

_OBSERVATION = "observation"


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
        env: the environment.
        num_steps: truncate episodes after that many steps; None leaves their length alone.
        flatten: make one vector of the observation; False leaves pictures and dictionaries.

    Raises:
        ValueError: if actions are neither continuous and bounded nor choices, or observations are
            no arrays and not to be flattened.
    """
    env = _flat(env) if flatten else _by_entry(env)
    env = _with_plain_actions(env)
    return env if num_steps is None else gymnasium.wrappers.TimeLimit(env, num_steps)


def check_workers(make: Callable[[], gymnasium.Env]) -> None:
    """Refuse environments whose observations processes cannot hand over, which are arrays alone.

    Raises:
        ValueError: for dictionaries.
    """
    probe = make()
    try:
        if isinstance(probe.observation_space, Dict):
            raise ValueError("workers are for observations that are arrays: use workers=0.")
    finally:
        probe.close()


class FloatCosts(gymnasium.Wrapper):
    """Makes costs in `info` floats.

    Gymnasium puts those of a batch into an array of the type that the first row reports: beside an
    integer 0 all costs would be rounded down, and booleans of NumPy's would be no numbers at all.

    Args:
        env: the environment.
        cost_keys: names in `info`; what is no single number stays as it is.

    Examples:
        >>> class Push(gymnasium.Env):
        ...     def step(self, action):
        ...         return 0, 0.0, False, False, {"cost": 0, "pushes": 3}
        >>> FloatCosts(Push(), ["cost"]).step(None)[-1]
        {'cost': 0.0, 'pushes': 3}
    """

    def __init__(self, env: gymnasium.Env, cost_keys: Sequence[str]) -> None:
        super().__init__(env)
        self._cost_keys = list(cost_keys)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, and convert what is reported."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        costs = {
            key: float(info[key])
            for key in self._cost_keys
            if isinstance(info.get(key), bool | int | float | np.generic)
            and not isinstance(info[key], np.flexible)
        }
        return observation, reward, terminated, truncated, {**info, **costs}


# Not by the wrappers that Gymnasium has for both: they keep lambdas, which no pickle takes.
def _flat(env: gymnasium.Env) -> gymnasium.Env:
    space = env.observation_space
    vectors = Box(-np.inf, np.inf, (gymnasium.spaces.flatdim(space),), np.float32)
    return gymnasium.wrappers.TransformObservation(env, partial(_vector, space), vectors)


def _by_entry(env: gymnasium.Env) -> gymnasium.Env:
    space = env.observation_space
    if isinstance(space, Dict):
        entries = Dict({name: _entry_space(part) for name, part in space.items()})
        nested = Dict({_OBSERVATION: entries})
        return gymnasium.wrappers.TransformObservation(env, partial(_entries, space), nested)
    if not isinstance(space, Box):
        raise ValueError(
            "Policies take observations that are arrays (a Box) or dictionaries, but "
            f"{env.unwrapped} has {space}. flatten=true makes one vector of it: kinds (Discrete) "
            "become one-hot."
        )
    return env if _is_picture(space) else _flat(env)


def _is_picture(space: gymnasium.Space) -> bool:
    return isinstance(space, Box) and len(space.shape) == 3


def _entry_space(space: gymnasium.Space) -> gymnasium.Space:
    if _is_picture(space):
        return space
    return Box(-np.inf, np.inf, (gymnasium.spaces.flatdim(space),), np.float32)


def _entries(space: Dict, observation: dict[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """Pictures as they are, all others as vectors, below one name."""
    entries = {
        name: observation[name] if _is_picture(part) else _vector(part, observation[name])
        for name, part in space.items()
    }
    return {_OBSERVATION: entries}


def _with_plain_actions(env: gymnasium.Env) -> gymnasium.Env:
    actions = env.action_space
    if isinstance(actions, Box) and not np.issubdtype(actions.dtype, np.floating):
        raise ValueError(
            f"{env.unwrapped} has actions that are whole numbers in a Box, {actions}: a choice of "
            "one of several is Discrete or MultiDiscrete."
        )
    if isinstance(actions, Box) and actions.is_bounded():
        plain: gymnasium.Space = Box(-1.0, 1.0, actions.shape, actions.dtype.type)
        return gymnasium.wrappers.TransformAction(env, partial(_stretched, actions), plain)
    start = getattr(actions, "start", None)
    if isinstance(actions, Discrete):
        plain = Discrete(int(actions.n))
    elif isinstance(actions, MultiDiscrete) and actions.nvec.ndim == 1:
        plain = MultiDiscrete(actions.nvec)
    else:
        raise ValueError(
            "The algorithms need actions that are continuous and bounded (a Box) or choices "
            f"(Discrete, MultiDiscrete), but {env.unwrapped} has {actions}."
        )
    if not np.any(start):
        return env
    return gymnasium.wrappers.TransformAction(env, partial(np.add, start), plain)


def _vector(space: gymnasium.Space, observation: Any) -> np.ndarray:
    return np.asarray(gymnasium.spaces.flatten(space, observation)).astype(np.float32)


def _stretched(space: Box, action: np.ndarray) -> np.ndarray:
    """From [-1, 1], and what is beyond, to the bounds."""
    middle, half = space.high / 2 + space.low / 2, space.high / 2 - space.low / 2
    return np.clip(middle + half * action, space.low, space.high)
