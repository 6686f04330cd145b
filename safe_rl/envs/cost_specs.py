"""Specs of costs: what is known of the most that a step can cost."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchrl.data import Bounded, TensorSpec, Unbounded

__all__ = ["cost_spec"]


def cost_spec(
    highest: float | None, shape: Sequence[int], device: torch.device | None = None
) -> TensorSpec:
    """Spec of a step's cost, float32, from 0 to the most that is known of it, if anything is."""
    if highest is None:
        return Unbounded(shape=shape, device=device)
    return Bounded(0.0, highest, shape=shape, device=device, dtype=torch.float32)
