"""Specs of the environment: shapes, types and bounds of everything it reads and writes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from safe_rl.envs.safety_gym.observing.observations import Observer
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.simulated import Specs


def make_specs(
    config: SafetyGymConfig,
    observer: Observer,
    control_range: tuple[Tensor, Tensor],
    cost_keys: Sequence[str],
    num_envs: int,
    device: torch.device | None,
) -> Specs:
    """Describe an environment.

    Args:
        config: the environment.
        observer: what it observes.
        control_range: lowest and highest control of every actuator, [nu] each.
        cost_keys: costs, which stand beside the reward.
        num_envs: N.
        device: where the TensorDicts live.
    """
    batch, scalar = (num_envs,), (num_envs, 1)
    kind: dict[str, Any] = {"dtype": torch.float32, "device": device}
    flag = Binary(1, shape=scalar, dtype=torch.bool, device=device)
    highest = 1.0 if config.constrain_indicator else torch.finfo(torch.float32).max
    low, high = (bound.to(torch.float32).expand(num_envs, -1) for bound in control_range)
    return Specs(
        observation=Composite(
            observation=_observation(config, observer, num_envs, kind),
            goal_met=flag.clone(),
            shape=batch,
        ),
        action=Bounded(low, high, **kind),
        reward=Composite(
            reward=Unbounded(shape=scalar, **kind),
            **{key: Bounded(0.0, highest, shape=scalar, **kind) for key in cost_keys},
            shape=batch,
        ),
        done=Composite(
            **{key: flag.clone() for key in ("done", "terminated", "truncated")}, shape=batch
        ),
    )


def _observation(
    config: SafetyGymConfig, observer: Observer, num_envs: int, kind: dict[str, Any]
) -> TensorSpec:
    """One flat vector, or every component in its own shape, each within its bounds."""
    columns = torch.tensor([observer.bounds[name] for name in observer.columns]).T
    widths = torch.tensor([math.prod(shape) for shape in observer.shapes.values()])
    if config.observation_flatten:
        return _within(columns.repeat_interleave(widths, dim=1), (num_envs, observer.size), kind)
    components = {
        name: _within(columns[:, i : i + 1].flatten(), (num_envs, *shape), kind)
        for i, (name, shape) in enumerate(observer.shapes.items())
    }
    return Composite(components, shape=(num_envs,))


def _within(bounds: Tensor, shape: tuple[int, ...], kind: dict[str, Any]) -> TensorSpec:
    """Numbers within (low, high); where only some are bounded the others are as good as not.

    TorchRL draws from a spec by its width, and that of infinite bounds makes numbers that are none.
    """
    if bounds.isinf().all():
        return Unbounded(shape=shape, **kind)
    # half as far as there are numbers, so that there is one for the width
    far = torch.finfo(kind["dtype"]).max / 2
    low, high = (bound.clamp(-far, far).expand(shape).clone() for bound in bounds)
    return Bounded(low, high, shape=shape, **kind)
