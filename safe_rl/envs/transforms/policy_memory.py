"""What a policy remembers of an episode, kept from step to step by the environment."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, TensorSpec, Unbounded

from safe_rl.envs.transforms.base import ConstraintTransform

__all__ = ["PolicyMemory"]

MEMORY, FIRST = "memory", "is_init"


class PolicyMemory(ConstraintTransform):
    """Carry what a policy leaves under ``("next", "memory")`` to its next step as ``memory``.

    It is 0 when an episode begins, and `is_init` says so. This is TorchRL's `TensorDictPrimer` and
    `InitTracker` in one that snapshots and resumed runs know of: a policy goes on remembering where
    the worlds go on. A policy that leaves nothing remembers what it did before.

    Args:
        size: numbers that are remembered.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env = TransformedEnv(SafetyGymEnv("PointGoal1", num_envs=2, seed=0), PolicyMemory(4))
        >>> state = env.reset()
        >>> state["memory"].shape, bool(state["is_init"].all())
        (torch.Size([2, 4]), True)
    """

    def __init__(self, size: int) -> None:
        super().__init__()
        self._size = size

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return no memories."""
        nothing = torch.zeros(*done.shape[:-1], self._size, device=done.device)
        return {MEMORY: nothing, FIRST: torch.ones_like(done)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        memory = next_tensordict.get(MEMORY, self._rows[MEMORY])
        self._rows = {MEMORY: memory, FIRST: torch.zeros_like(self._rows[FIRST])}
        return self._call(next_tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.update(self._rows)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add what is remembered, and whether an episode begins."""
        batch, device = observation_spec.shape, observation_spec.device
        observation_spec[MEMORY] = Unbounded(shape=(*batch, self._size), device=device)
        observation_spec[FIRST] = Binary(1, shape=(*batch, 1), dtype=torch.bool, device=device)
        return observation_spec
