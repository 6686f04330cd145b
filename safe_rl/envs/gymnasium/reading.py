"""Costs that stand in the `info` of Gymnasium's environments, in TorchRL's data."""

from __future__ import annotations

import math
import reprlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs.gym_like import BaseInfoDictReader

from safe_rl.envs.cost_specs import cost_spec
from safe_rl.envs.errors import ConfigError, nearest

__all__ = ["CostReader", "FloatCosts"]


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


class CostReader(BaseInfoDictReader):
    """Reads costs from `info` into the TensorDict, float32 [N, 1]; 0 where none is reported.

    Some environments report a cost only where it occurs. A name that no info has had for as long as
    an episode lasts may be a wrong one: a warning says so, once, with the nearest that there is.

    Args:
        cost_keys: names in `info`.
        batch_size: [N], or [] of a single environment.
        highest: name -> the most that a step can cost, where that is known.
        patience: steps until the warning; None: never.

    Examples:
        >>> from tensordict import TensorDict
        >>> reader = CostReader(["cost_crash"], [2])
        >>> reader({"speed": np.ones(2)}, TensorDict(batch_size=[2]))["cost_crash"].flatten()
        tensor([0., 0.])

    Raises:
        ConfigError: by the call, if a cost is not one number per step.
    """

    def __init__(
        self,
        cost_keys: Sequence[str],
        batch_size: Sequence[int],
        highest: Mapping[str, float] | None = None,
        patience: int | None = None,
    ) -> None:
        self._cost_keys = list(cost_keys)
        self._shape = (*batch_size, 1)
        self._highest = dict(highest or {})
        self._patience = patience
        self._unseen, self._names = set(self._cost_keys), set[str]()
        self._num_steps = 0

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        """Write the costs of a step."""
        if self._unseen:
            self._look_for_unseen(info_dict, is_step="reward" in tensordict)
        for key in self._cost_keys:
            tensordict[key] = self._one_each(key, info_dict.get(key, np.zeros(self._shape)))
        return tensordict

    def _one_each(self, key: str, value: Any) -> Tensor:
        try:
            return torch.as_tensor(value, dtype=torch.float32).reshape(self._shape)
        except (TypeError, ValueError, RuntimeError):
            raise ConfigError(
                f"info['{key}'] must be one number per step, as a cost is; the steps of "
                f"{math.prod(self._shape)} environments brought {reprlib.repr(value)}."
            ) from None

    def _look_for_unseen(self, info_dict: Mapping[str, Any], is_step: bool) -> None:
        self._unseen.difference_update(info_dict)
        # names that begin so are Gymnasium's masks
        self._names.update(name for name in info_dict if not name.startswith("_"))
        self._num_steps += is_step
        if not self._unseen or self._patience is None or self._num_steps <= self._patience:
            return
        others = self._names.difference(self._cost_keys)
        for key in sorted(self._unseen):
            warnings.warn(
                f"The cost '{key}' is in no info of the first {self._patience} steps, and counts "
                f"as 0.{nearest(key, others)} The infos have "
                f"{', '.join(sorted(others)) or 'no other'}. If it is reported only where it "
                "occurs, it may not have occurred yet.",
                stacklevel=2,
            )
        self._unseen.clear()

    @property
    def info_spec(self) -> Composite:
        """Shapes and types of the costs."""
        costs = {key: cost_spec(self._highest.get(key), self._shape) for key in self._cost_keys}
        return Composite(costs, shape=self._shape[:-1])
