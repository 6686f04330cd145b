"""N environments of Gymnasium as one of TorchRL, with their costs beside the reward.

Wrappers convert observations, actions and costs of the single environments.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from gymnasium.wrappers import FlattenObservation, TimeLimit, TransformAction
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs import default_info_dict_reader

from safe_rl.envs.keys import COST, ConfigError, is_cost
from safe_rl.envs.pictures import chosen_rows
from safe_rl.envs.torchrl import TorchRLEnv
from safe_rl.naming import did_you_mean

_WRITTEN = ("action", "reward", "done", "terminated", "truncated")
_NUMBERS = (Box, Discrete, MultiDiscrete, spaces.MultiBinary, spaces.Dict, spaces.Tuple)
_Bool = bool | np.bool_
COST_SUM = "cost_sum"  # Safety-Gymnasium's name for the sum of all kinds


def make_adapted(
    make: Callable[[], gymnasium.Env],
    num_steps: int,
    flatten: bool,
    cost_keys: Sequence[str],
    watch: bool = False,
) -> gymnasium.Env:
    """Make an environment whose choices start at 0 and whose costs in `info` are floats.

    Episodes are truncated after `num_steps`. With `flatten`, observations are vectors.
    """
    env: gymnasium.Env = CheckedSteps(make(), cost_keys, watch)
    seen, actions = env.observation_space, env.action_space
    entries = dict(seen) if isinstance(seen, spaces.Dict) else {}
    if isinstance(actions, spaces.Tuple | spaces.Dict):
        raise ConfigError(f"Actions have several parts, {actions}: join them by a wrapper.")
    for name, space in (entries or {"observation": seen}).items():
        if not isinstance(space, (*_NUMBERS, spaces.Text) if flatten else _NUMBERS):
            raise ConfigError(
                f"'{name}' is observed, a {type(space).__name__}, and networks take numbers: leave "
                "it out by a wrapper, such as Gymnasium's FilterObservation."
            )
        if flatten and space.dtype == np.uint8 and len(space.shape or ()) > 1:
            warnings.warn(
                f"'{name}' is a picture, {space.shape}: as a part of a vector it is not scaled. "
                "flatten=false keeps pictures, for model=cnn or model=dict.",
                stacklevel=2,
            )
    if flatten:
        env = FlattenObservation(env)
    elif isinstance(seen, spaces.Tuple):
        raise ConfigError("The observation is a Tuple: set flatten=true, which makes one vector.")
    elif taken := {*_WRITTEN, *cost_keys} & {*entries}:
        raise ConfigError(
            f"The observation has an entry '{min(taken)}': rename it, because a step writes one of "
            "this name."
        )
    elif dotted := [key for key in entries if "." in key]:
        raise ConfigError(
            f"The observation has an entry '{dotted[0]}': rename it, because dots stand between "
            "the names of nested entries."
        )
    elif shifted := [x for x in (seen, *entries.values()) if np.any(getattr(x, "start", 0))]:
        raise ConfigError(
            f"{shifted[0]} is observed: let it begin at 0, or set flatten=true without privileged."
        )
    if isinstance(actions, Discrete | MultiDiscrete) and np.any(actions.start):
        choices = (
            Discrete(actions.n) if isinstance(actions, Discrete) else MultiDiscrete(actions.nvec)
        )
        env = TransformAction(env, partial(np.add, actions.start), choices)
    return TimeLimit(env, num_steps)


class CheckedSteps(gymnasium.Wrapper):
    """Checks what an environment returns, and converts its costs to floats in `info`.

    A step may return six values, as in Safety-Gymnasium: the third one is then the cost.

    Gymnasium puts the costs of a batch into an array of the first row's type. If this is an
    integer, it rounds the costs of the other rows.

    Raises:
        ConfigError: At a reset or step that returns something else than the environment's spaces
            say; the message names the entry and the step.
    """

    def __init__(self, env: gymnasium.Env, cost_keys: Sequence[str], watch: bool) -> None:
        super().__init__(env)
        self._cost_keys, self._step, self._watch = list(cost_keys), 0, watch
        self._told: list[str] = []  # costs that are not counted, once each

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset, and check the observation."""
        self._step = 0
        observation, info = self.env.reset(**kwargs)
        self._check("observation", self.observation_space, observation)
        return observation, info or {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, check what is returned, and convert the costs."""
        self._step += 1
        answer: Any = self.env.step(action)
        if not isinstance(answer, tuple) or len(answer) not in (5, 6):
            raise self._wrong("what a step returns", "five values, or six with a cost", answer)
        observation, reward, *cost, terminated, truncated, info = answer
        if not isinstance(info, dict):
            raise self._wrong("info", "a dictionary", info)
        self._check("observation", self.observation_space, observation)
        if cost and isinstance(cost[0], _Bool) and not isinstance(truncated, _Bool):
            order = "observation, reward, cost, terminated, truncated, info"
            raise self._wrong(f"the fifth value of a step ({order})", "True or False", truncated)
        if cost and self._cost_keys and COST not in self._cost_keys:
            raise ConfigError(
                f"{self.unwrapped}: a step returns its cost as the third of six values: name "
                f"'{COST}' in cost_keys, too."
            )
        info = {**info, **dict(zip([COST], cost, strict=False))}
        if COST_SUM in info and COST_SUM not in self._cost_keys:  # no kind of its own
            info = {COST: info.pop(COST_SUM), **info}
        if self._watch and not cost:  # that of six values is of all kinds
            self._tell_uncounted(info)
        info |= {k: self._number(f"info['{k}']", info[k]) for k in self._cost_keys if k in info}
        for name, end in (("terminated", terminated), ("truncated", truncated)):
            if not isinstance(end, _Bool | int | np.integer):
                raise self._wrong(name, "True or False", end)
        return observation, self._number("the reward", reward), terminated, truncated, info

    def _tell_uncounted(self, info: dict[str, Any]) -> None:
        known = (*self._cost_keys, *self._told)
        for key in [key for key in info if is_cost(key) and key not in known]:
            self._told.append(key)
            kept = (
                " 'cost' is taken as the environment gives it." if COST in self._cost_keys else ""
            )
            warnings.warn(
                # without the step, which differs among rows: Python shows equal warnings once
                f"info['{key}'] is not counted as a cost, because it is not in "
                f"env.cost_keys=[{','.join(self._cost_keys)}].{kept}",
                stacklevel=2,
            )

    def _check(self, name: str, space: gymnasium.Space, value: Any) -> None:
        """Check shapes, types and choices; numbers of a Box may be outside its bounds."""
        if isinstance(space, spaces.Dict | spaces.Tuple):
            parts: Any = space.spaces
            for key in parts if isinstance(parts, dict) else range(len(parts)):
                self._check(f"{name}[{key!r}]", parts[key], value[key])
            return
        array = np.asarray(value)
        is_array = array.shape == space.shape and array.dtype.kind in "fiub"
        if not (is_array if isinstance(space, Box) else space.contains(value)):
            raise self._wrong(name, f"in {space}", value)

    def _number(self, name: str, value: Any) -> float:
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            raise self._wrong(name, "one number", value) from None

    def _wrong(self, name: str, wanted: str, value: Any) -> ConfigError:
        return ConfigError(
            f"{self.unwrapped}: {name} must be {wanted}, but step {self._step} returned a "
            f"{type(value).__name__}, {value!r:.200}."
        )


class CostReader(default_info_dict_reader):
    """TorchRL's reader of costs in `info`, which writes 0 where none is reported.

    Some environments report a cost only when it occurs. If no `info` of the first `patience` steps
    contains a cost, there is one warning.
    """

    def __init__(self, cost_keys: Sequence[str], num_envs: int, patience: int) -> None:
        costs = {key: Unbounded((num_envs, 1)) for key in cost_keys}
        super().__init__(list(cost_keys), Composite(costs, shape=(num_envs,)))
        self._patience, self._num_steps = patience, 0
        self._unseen, self._names = set(cost_keys), set[str]()

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        """Write the costs of a step."""
        if "reward" in tensordict and self._unseen:
            self._look_at_names(info_dict)
        return super().__call__(info_dict, tensordict)

    def _look_at_names(self, info_dict: Mapping[str, Any]) -> None:
        # Gymnasium's masks begin with an underscore
        self._names |= {name for name in info_dict if not name.startswith("_")}
        self._unseen -= self._names
        self._num_steps += 1
        if self._num_steps < self._patience:
            return
        for key in sorted(self._unseen):
            others = sorted(self._names.difference(self.keys))
            warnings.warn(
                f"The cost '{key}' is in no info of the first {self._patience} steps, and counts "
                f"as 0.{did_you_mean(key, others)} The infos have {', '.join(others) or 'no other'}"
                ". If the cost is reported only when it occurs, it may not have occurred yet.",
                stacklevel=3,
            )
        self._unseen.clear()


class GymnasiumEnv(TorchRLEnv):
    """N environments of Gymnasium as one of TorchRL, made by `from_gymnasium`."""

    @property
    def seconds_per_step(self) -> float | None:
        """Duration of a step in the environment's own time [s]; None if unknown."""
        rate = (getattr(self.base_env._env, "metadata", None) or {}).get("render_fps")
        return 1 / rate if rate else None

    def render(self, rows: int | Sequence[int] | None = None) -> np.ndarray:
        """Return frames of the environments as they draw them, uint8 [R, height, width, 3].

        An integer as `rows` returns one frame, None those of all rows.

        Raises:
            ValueError: If the environments draw no frames.
        """
        frames = self.base_env._env.render()
        if frames is None or frames[0] is None:
            raise ValueError("The environment draws no frames: set env.render_mode=rgb_array.")
        chosen, is_one = chosen_rows(rows, len(frames))
        return np.asarray(frames[chosen[0]] if is_one else [frames[row] for row in chosen])
