"""Specs of what is observed: shapes and bounds."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from safe_rl.envs.safety_gym.observing.observations import Observer
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig


def observation_spec(
    config: SafetyGymConfig, observer: Observer, num_envs: int, device: torch.device | None
) -> TensorSpec:
    """One flat vector, or every component in its own shape, each within its bounds."""
    kind: dict[str, Any] = {"dtype": torch.float32, "device": device}
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
