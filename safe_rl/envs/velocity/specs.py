"""Specs of the environment: shapes, types and bounds of everything it reads and writes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from safe_rl.envs.simulated import Specs


def make_velocity_specs(
    observation_size: int,
    control_range: tuple[Tensor, Tensor],
    cost_keys: Sequence[str],
    num_envs: int,
    device: torch.device | None,
) -> Specs:
    """Describe an environment.

    Args:
        observation_size: numbers that a robot observes.
        control_range: lowest and highest control of every actuator, [nu] each.
        cost_keys: costs, which stand beside the reward.
        num_envs: N.
        device: where the TensorDicts live.
    """
    batch, scalar = (num_envs,), (num_envs, 1)
    kind: dict[str, Any] = {"dtype": torch.float32, "device": device}
    flag = Binary(1, shape=scalar, dtype=torch.bool, device=device)
    low, high = (bound.to(torch.float32).expand(num_envs, -1) for bound in control_range)
    return Specs(
        observation=Composite(
            observation=Unbounded(shape=(num_envs, observation_size), **kind), shape=batch
        ),
        action=Bounded(low, high, **kind),
        reward=Composite(
            reward=Unbounded(shape=scalar, **kind),
            **{key: Bounded(0.0, 1.0, shape=scalar, **kind) for key in cost_keys},
            shape=batch,
        ),
        done=Composite(
            **{key: flag.clone() for key in ("done", "terminated", "truncated")}, shape=batch
        ),
    )
