"""N environments of Gymnasium as one of TorchRL, with their costs beside the reward.

Wrappers convert observations, actions and costs of the single environments.
"""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete
from gymnasium.wrappers import TimeLimit, TransformAction, TransformObservation
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs.gym_like import BaseInfoDictReader

from safe_rl.envs.keys import COST, ConfigError, is_cost
from safe_rl.envs.pictures import chosen_rows, resize
from safe_rl.envs.torchrl import TorchRLEnv
from safe_rl.naming import did_you_mean

_WRITTEN = ("action", "reward", "done", "terminated", "truncated")
COST_SUM = "cost_sum"  # Safety-Gymnasium's name for the sum of all kinds


def make_adapted(
    make: Callable[[], gymnasium.Env],
    num_steps: int,
    flatten: bool,
    cost_keys: Sequence[str],
    watch: bool = False,
) -> gymnasium.Env:
    """Make an environment whose choices start at 0 and whose costs in `info` are floats.

    Episodes are truncated after `num_steps`. With `flatten`, observations are float32 vectors.
    """
    env: gymnasium.Env = CheckedSteps(make(), cost_keys, watch)
    seen, actions = env.observation_space, env.action_space
    _check_space(seen, flatten)
    taken = {*_WRITTEN, *cost_keys} & set(seen if isinstance(seen, spaces.Dict) else ())
    if taken and not flatten:
        raise ConfigError(
            f"The observation has an entry '{min(taken)}': rename it, because a step writes one of "
            "this name."
        )
    if not isinstance(actions, Box | Discrete | MultiDiscrete | MultiBinary):
        raise ConfigError(
            "The algorithms need actions that are continuous and bounded (a Box) or choices "
            f"(Discrete, MultiDiscrete), got {actions}."
        )
    # Gymnasium's own wrapper, FlattenObservation, contains lambdas and cannot be pickled.
    if flatten:
        space = Box(-np.inf, np.inf, (spaces.flatdim(seen),), np.float32)
        env = TransformObservation(env, partial(_vector, seen), space)
    if isinstance(actions, Discrete | MultiDiscrete) and np.any(actions.start):
        choices = (
            Discrete(actions.n) if isinstance(actions, Discrete) else MultiDiscrete(actions.nvec)
        )
        env = TransformAction(env, partial(np.add, actions.start), choices)
    return TimeLimit(env, num_steps)


def _check_space(space: gymnasium.Space, flatten: bool) -> None:
    if isinstance(space, spaces.Dict):
        for key, inner in space.items():
            if "." in key:
                raise ConfigError(
                    f"The observation has an entry '{key}': rename it, because dots stand between "
                    "the names of nested entries."
                )
            _check_space(inner, flatten)
    elif isinstance(space, spaces.Graph | spaces.Sequence | spaces.Text):
        raise ConfigError(f"The observation has a {space}, which cannot become an array.")
    elif isinstance(space, spaces.Tuple) and not flatten:
        raise ConfigError("The observation is a Tuple: set flatten=true, which makes one vector.")


def _vector(space: gymnasium.Space, observation: Any) -> np.ndarray:
    return np.asarray(spaces.flatten(space, observation)).astype(np.float32)


class CheckedSteps(gymnasium.Wrapper):
    """Checks what an environment returns, and converts the costs in `info` to floats.

    Gymnasium puts the costs of a batch into an array of the first row's type. If this is an
    integer, it rounds the costs of the other rows.

    Raises:
        ConfigError: At a reset or step that returns something else than the environment's spaces
            say; the message names the entry, its shape and the step.
    """

    def __init__(self, env: gymnasium.Env, cost_keys: Sequence[str], watch: bool) -> None:
        super().__init__(env)
        self._cost_keys, self._step, self._watch = list(cost_keys), 0, watch

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset, and check what is returned."""
        self._step = 0
        answer = self._ask(self.env.reset, **kwargs)
        if not isinstance(answer, tuple) or len(answer) != 2:
            raise self._wrong("what a reset returns", "(observation, info)", answer)
        observation, info = answer
        self._check("observation", self.observation_space, observation)
        return observation, {} if info is None else info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, check what is returned, and convert the costs."""
        self._step += 1
        answer = self._ask(self.env.step, action)
        if not isinstance(answer, tuple):
            raise self._wrong("what a step returns", "a tuple", answer)
        *values, info = answer
        if len(values) != 4:
            raise ConfigError(
                f"A step of {self.env} returned {len(values) + 1} values instead of five. If its "
                "cost is one of six values, use from_six_values."
            )
        if not isinstance(info, dict):
            raise self._wrong("info", "a dictionary", info)
        self._check("observation", self.observation_space, values[0])
        if COST_SUM in info and COST_SUM not in self._cost_keys:  # no kind of its own
            info = {COST: info[COST_SUM], **info}
            del info[COST_SUM]
        costs = {key: self._number(f"info['{key}']", info[key]) for key in self._costs_of(info)}
        for name, end in zip(("terminated", "truncated"), values[2:], strict=True):
            if not isinstance(end, bool | np.bool_ | int | np.integer):
                raise self._wrong(name, "True or False", end)
        return values[0], self._number("the reward", values[1]), *values[2:], {**info, **costs}

    def _ask(self, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Call the environment; name it where Gymnasium's wrappers cannot take its answer."""
        try:
            return method(*args, **kwargs)
        except (AssertionError, TypeError, ValueError, gymnasium.error.Error) as error:
            last = traceback.extract_tb(error.__traceback__)[-1].filename
            if not Path(last).is_relative_to(Path(gymnasium.__file__).parent):
                raise  # the environment's own error
            raise ConfigError(
                f"{self.unwrapped}: {method.__name__} failed at step {self._step}: {error}"
            ) from error

    def _costs_of(self, info: dict[str, Any]) -> list[str]:
        """Names of the costs in `info`; one warning about those that are not counted."""
        uncounted = [key for key in info if is_cost(key) and key not in self._cost_keys]
        if uncounted and self._watch:
            self._watch = False
            warnings.warn(
                f"info['{uncounted[0]}'] of step {self._step} is not counted as a cost, because it "
                f"is not in env.cost_keys=[{','.join(self._cost_keys)}].",
                stacklevel=2,
            )
        return [key for key in self._cost_keys if key in info]

    def _check(self, name: str, space: gymnasium.Space, value: Any) -> None:
        if isinstance(space, spaces.Dict):
            for key, inner in space.items():
                if not isinstance(value, Mapping) or key not in value:
                    raise self._wrong(name, f"a dictionary with '{key}'", value)
                self._check(f"{name}['{key}']", inner, value[key])
        elif isinstance(space, spaces.Tuple):
            if not isinstance(value, list | tuple) or len(value) != len(space):
                raise self._wrong(name, f"a tuple of {len(space)}", value)
            for number, inner in enumerate(space):
                self._check(f"{name}[{number}]", inner, value[number])
        elif isinstance(space, Box | MultiBinary | MultiDiscrete | Discrete):
            self._check_array(name, space, value)

    def _check_array(self, name: str, space: gymnasium.Space, value: Any) -> None:
        try:
            array = np.asarray(value)
        except ValueError:
            raise self._wrong(name, f"numbers of the shape {space.shape}", value) from None
        kinds, wanted = ("fiub", "numbers") if isinstance(space, Box) else ("iub", "whole numbers")
        if array.shape != space.shape or array.dtype.kind not in kinds:
            raise self._wrong(name, f"{wanted} of the shape {space.shape}", value)
        if isinstance(space, Discrete | MultiDiscrete):
            sizes = space.n if isinstance(space, Discrete) else space.nvec
            if ((array < space.start) | (array >= space.start + sizes)).any():
                raise self._wrong(name, f"in {space}", value)

    def _number(self, name: str, value: Any) -> float:
        try:
            return float(value)
        except (TypeError, ValueError, OverflowError):
            raise self._wrong(name, "one number", value) from None

    def _wrong(self, name: str, wanted: str, value: Any) -> ConfigError:
        shape, kind = getattr(value, "shape", None), type(value).__name__
        got = (
            f"a {kind} of {value.dtype} and the shape {shape}" if shape else f"a {kind}, {value!r}"
        )
        return ConfigError(
            f"{self.unwrapped}: {name} must be {wanted}, but step {self._step} returned {got:.200}."
        )


class CostIntoInfo(gymnasium.Wrapper):
    """An environment whose step returns (observation, reward, cost, terminated, truncated, info).

    The wrapper's step returns Gymnasium's five values, with the cost in `info`.
    """

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take an action; ValueError if the environment returns another number of values."""
        values: tuple[Any, ...] = self.env.step(action)
        if len(values) != 6:
            raise ConfigError(
                f"A step of {self.env} returned {len(values)} values instead of six (observation, "
                "reward, cost, terminated, truncated, info). For an environment that returns five "
                "values and has the cost in info, use env=gymnasium."
            )
        observation, reward, cost, terminated, truncated, info = values
        return observation, reward, terminated, truncated, {**info, COST: float(cost)}


class CostReader(BaseInfoDictReader):
    """Reads costs from `info` into the TensorDict, float32 [N, 1]; 0 where none is reported.

    Some environments report a cost only when it occurs. If no `info` of the first `patience` steps
    contains a cost, there is one warning.
    """

    def __init__(self, cost_keys: Sequence[str], num_envs: int, patience: int) -> None:
        self._cost_keys, self._shape = list(cost_keys), (num_envs, 1)
        self._patience, self._num_steps = patience, 0
        self._unseen, self._names = set(cost_keys), set[str]()

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        """Write the costs of a step."""
        if "reward" in tensordict and self._unseen:
            self._look_at_names(info_dict)
        for key in self._cost_keys:
            values = info_dict.get(key, np.zeros(self._shape))
            tensordict[key] = torch.as_tensor(values, dtype=torch.float32).reshape(self._shape)
        return tensordict

    def _look_at_names(self, info_dict: Mapping[str, Any]) -> None:
        # Gymnasium's masks begin with an underscore
        self._names |= {name for name in info_dict if not name.startswith("_")}
        self._unseen -= self._names
        self._num_steps += 1
        if self._num_steps < self._patience:
            return
        for key in sorted(self._unseen):
            others = sorted(self._names.difference(self._cost_keys))
            warnings.warn(
                f"The cost '{key}' is in no info of the first {self._patience} steps, and counts "
                f"as 0.{did_you_mean(key, others)} The infos have {', '.join(others) or 'no other'}"
                ". If the cost is reported only when it occurs, it may not have occurred yet.",
                stacklevel=3,
            )
        self._unseen.clear()

    @property
    def info_spec(self) -> Composite:
        """Shapes and types of the costs."""
        costs = {key: Unbounded(self._shape) for key in self._cost_keys}
        return Composite(costs, shape=self._shape[:-1])


class GymnasiumEnv(TorchRLEnv):
    """N environments of Gymnasium as one of TorchRL, made by `from_gymnasium`."""

    @property
    def seconds_per_step(self) -> float | None:
        """Duration of a step in the environment's own time [s]; None if unknown."""
        rate = (getattr(self.base_env._env, "metadata", None) or {}).get("render_fps")
        return 1 / rate if rate else None

    def render(
        self,
        rows: int | Sequence[int] | None = None,
        *,
        camera: str = "free",
        width: int = 480,
        height: int = 360,
    ) -> np.ndarray:
        """Return the environments' own frames, resized; arguments as of `SimulatedEnv.render`.

        Raises:
            ValueError: For a camera other than "free", or if the environments draw no frames.
        """
        if camera != "free":
            raise ValueError(
                f"There is no camera '{camera}': an environment of Gymnasium uses its own camera. "
                "Its arguments may change it (env.kwargs)."
            )
        frames = self.base_env._env.render()
        if frames is None or frames[0] is None:
            raise ValueError("The environment draws no frames: set env.render_mode=rgb_array.")
        chosen, is_one = chosen_rows(rows, len(frames))
        drawn = np.stack([_fit(np.asarray(frames[row]), width, height) for row in chosen])
        return drawn[0] if is_one else drawn


def _fit(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize with the same aspect ratio, into the upper left corner of [height, width, 3]."""
    scale = min(width / picture.shape[1], height / picture.shape[0])
    lines, columns = (max(1, int(scale * size)) for size in picture.shape[:2])
    canvas = np.zeros((height, width, 3), dtype=np.uint8)
    canvas[:lines, :columns] = resize(picture, columns, lines)
    return canvas
