"""What Gymnasium's environments say, as TorchRL's data: costs in `info`, parts of observations."""

from __future__ import annotations

import math
import reprlib
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs.gym_like import BaseInfoDictReader

from safe_rl import naming
from safe_rl.envs.cost_specs import cost_spec
from safe_rl.envs.costs import COST, is_cost
from safe_rl.envs.errors import ConfigError, nearest

__all__ = ["CostReader", "columns_of"]

_MISSPELT = 0.85
"""Likeness above which two names are thought to be one."""


class CostReader(BaseInfoDictReader):
    """Reads costs from `info` into the TensorDict, float32 [N, 1]; 0 where none is reported.

    Some environments report a cost only where it occurs. So a warning says, once, which name no
    info has had for as long as an episode lasts, and which cost nobody counts because it was first
    reported later; a name that is missing beside one that is nearly the same is an error.

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
        ConfigError: by the call, if a cost is not one number per step, or its name is misspelt.
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
        """Take note of the names that a step brings."""
        # names that begin so are Gymnasium's masks
        new = {name for name in info_dict if not name.startswith("_")} - self._names
        self._names |= new
        self._unseen -= new
        others = self._names.difference(self._cost_keys)
        if new and self._num_steps and COST not in self._cost_keys:
            _warn_of_uncounted(filter(is_cost, new & others), self._cost_keys)
        for key in self._unseen if new else ():
            if alike := naming.nearest(key, others, _MISSPELT):
                raise ConfigError(
                    f"No info has the cost '{key}'. Did you mean '{alike}'? If there are both, "
                    f"let every step report '{key}', or name both in 'cost_keys'."
                )
        self._num_steps += 1
        if self._patience is not None and self._num_steps > self._patience:
            _warn_of_unseen(self._unseen, others, self._patience)
            self._unseen.clear()

    @property
    def info_spec(self) -> Composite:
        """Shapes and types of the costs."""
        costs = {key: cost_spec(self._highest.get(key), self._shape) for key in self._cost_keys}
        return Composite(costs, shape=self._shape[:-1])


def columns_of(spec: TensorSpec) -> dict[str, slice]:
    """Columns of every component of N observations, of entries as if they were one vector."""
    parts = dict(spec.items()) if isinstance(spec, Composite) else {"observation": spec}
    sizes = {str(name): part.shape[1:].numel() for name, part in sorted(parts.items())}
    ends = accumulate(sizes.values())
    return {name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}


def _warn_of_uncounted(keys: Iterable[str], named: Sequence[str]) -> None:
    for key in keys:
        warnings.warn(
            f"A step reports the cost '{key}', which the first one did not, and which counts "
            f"nowhere: 'cost_keys' are {', '.join(named)}. Name it there, too.",
            stacklevel=4,
        )


def _warn_of_unseen(keys: Iterable[str], others: Collection[str], patience: int) -> None:
    for key in sorted(keys):
        warnings.warn(
            f"The cost '{key}' is in no info of the first {patience} steps, and counts as 0."
            f"{nearest(key, others)} The infos have {', '.join(sorted(others)) or 'no other'}. If "
            "it is reported only where it occurs, it may not have occurred yet.",
            stacklevel=4,
        )
