"""N environments of Gymnasium as one of TorchRL, with their costs beside the reward."""

from __future__ import annotations

import math
import reprlib
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import GymWrapper, Transform, TransformedEnv
from torchrl.envs.gym_like import BaseInfoDictReader

from safe_rl import naming
from safe_rl.envs.contract import ConstrainedEnv, add_columns
from safe_rl.envs.costs import COST
from safe_rl.envs.errors import ConfigError, nearest

__all__ = ["CostReader", "GymnasiumEnv", "cost_spec"]

_MISSPELT = 0.85
"""Likeness above which two names are thought to be one."""


class CostReader(BaseInfoDictReader):
    """Reads costs from `info` into the TensorDict, float32 [N, 1]; 0 where none is reported.

    Some environments report a cost only where it occurs. A warning names, once, a cost that no
    `info` has had for `patience` steps. A name that is missing while `info` has nearly the same one
    is an error.

    Args:
        cost_keys: Names in `info`.
        batch_size: [N], or [] of a single environment.
        highest: Name -> the most that a step can cost, where that is known.
        patience: Steps until the warning; None: never.

    Raises:
        ConfigError: By the call, if a cost is not one number per step, or its name is misspelt.
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
        if "reward" in tensordict:
            self._look_at_names(info_dict)
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

    def _look_at_names(self, info_dict: Mapping[str, Any]) -> None:
        # names that begin so are Gymnasium's masks
        new = {name for name in info_dict if not name.startswith("_")} - self._names
        self._names |= new
        self._unseen -= new
        others = self._names.difference(self._cost_keys)
        for key in self._unseen if new else ():
            if alike := naming.nearest(key, others, _MISSPELT):
                raise ConfigError(
                    f"No info has the cost '{key}'. Did you mean '{alike}'? If there are both, "
                    f"let every step report '{key}', or name both in 'cost_keys'."
                )
        self._num_steps += 1
        if self._patience is not None and self._num_steps > self._patience:
            for key in sorted(self._unseen):
                warnings.warn(
                    f"The cost '{key}' is in no info of the first {self._patience} steps, and "
                    f"counts as 0.{nearest(key, others)} The infos have "
                    f"{', '.join(sorted(others)) or 'no other'}. If it is reported only where it "
                    "occurs, it may not have occurred yet.",
                    stacklevel=3,
                )
            self._unseen.clear()

    @property
    def info_spec(self) -> Composite:
        """Shapes and types of the costs."""
        costs = {key: cost_spec(self._highest.get(key), self._shape) for key in self._cost_keys}
        return Composite(costs, shape=self._shape[:-1])


class CostsAsRewards(Transform):
    """Moves costs from the observations to the rewards; adds `cost`, the sum, if it is missing."""

    def __init__(self, cost_keys: Sequence[str]) -> None:
        super().__init__()
        self._cost_keys = list(cost_keys)
        self._sums = COST not in self._cost_keys

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._sums:
            costs = torch.stack([next_tensordict[key] for key in self._cost_keys])
            next_tensordict[COST] = costs.sum(0)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.exclude(*self._cost_keys)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Move the specs of the costs."""
        output_spec = super().transform_output_spec(output_spec)
        rewards = output_spec["full_reward_spec"]
        observations = output_spec["full_observation_spec"]
        for key in self._cost_keys:
            rewards[key] = observations[key]
            del observations[key]
        if self._sums:
            rewards[COST] = _spec_of_sum([rewards[key] for key in self._cost_keys])
        return output_spec


class GymnasiumEnv(ConstrainedEnv, TransformedEnv):
    """N environments of Gymnasium as one of TorchRL, made by `from_gymnasium`.

    Attributes:
        cost_keys: The aggregate `cost`, then one key per kind.
        observation_layout: One component, the whole observation; of a dictionary, its entries.
        max_episode_steps: The largest number of steps of an episode.
    """

    def __init__(self, base_env: GymWrapper, cost_keys: Sequence[str], num_steps: int) -> None:
        super().__init__(base_env, CostsAsRewards(cost_keys))
        self.cost_keys = [COST, *(key for key in cost_keys if key != COST)]
        self.observation_layout = _columns(base_env.observation_spec["observation"])
        self.max_episode_steps = num_steps

    @property
    def seconds_per_step(self) -> float | None:
        """What a step takes in the environment's own time [s], if it says that."""
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
        """Draw environments as they draw themselves, resized; as `SimulatedEnv.render`.

        Raises:
            ValueError: For a camera other than "free", or if they were made without pictures.
        """
        if camera != "free":
            raise ValueError(
                f"There is no camera '{camera}': an environment of Gymnasium has its own, which "
                "its arguments may change (env.kwargs)."
            )
        frames = self.base_env._env.render()
        if frames is None or frames[0] is None:
            raise ValueError("It was made without pictures: env.render_mode=rgb_array.")
        chosen = range(len(frames)) if rows is None else [rows] if isinstance(rows, int) else rows
        drawn = np.stack([_fit(np.asarray(frames[row]), width, height) for row in chosen])
        return drawn[0] if isinstance(rows, int) else drawn


def cost_spec(
    highest: float | None, shape: Sequence[int], device: torch.device | None = None
) -> TensorSpec:
    """Spec of a step's cost, float32, from 0 to the most that is known of it, if anything is."""
    if highest is None:
        return Unbounded(shape=shape, device=device)
    return Bounded(0.0, highest, shape=shape, device=device, dtype=torch.float32)


def _columns(spec: TensorSpec) -> dict[str, slice]:
    """Columns of every component of N observations, of entries as if they were one vector."""
    parts = dict(spec.items()) if isinstance(spec, Composite) else {"observation": spec}
    sizes = {str(name): part.shape[1:].numel() for name, part in sorted(parts.items())}
    return add_columns({}, sizes)


def _spec_of_sum(specs: Sequence[TensorSpec]) -> TensorSpec:
    highest = [float(spec.high.max()) for spec in specs if isinstance(spec, Bounded)]
    is_known = len(highest) == len(specs)
    return cost_spec(sum(highest) if is_known else None, specs[0].shape, specs[0].device)


def _fit(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize to the largest picture that keeps its form, in the corner of [height, width, 3]."""
    scale = min(width / picture.shape[1], height / picture.shape[0])
    lines, columns = (
        (np.arange(max(1, int(scale * size))) / scale).astype(int) for size in picture.shape[:2]
    )
    canvas = np.zeros((height, width, 3), dtype=np.uint8)
    canvas[: len(lines), : len(columns)] = picture[lines[:, None], columns]
    return canvas
