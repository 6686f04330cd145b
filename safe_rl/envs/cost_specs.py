"""Specs of costs: what is known of the most that a step can cost."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from torchrl.data import Bounded, TensorSpec, Unbounded

from safe_rl.envs.costs import COST

__all__ = ["cost_spec", "highest_costs"]


def highest_costs(names: Collection[str], ranges: Collection[str]) -> dict[str, float]:
    """The most that a step can cost, where that is known, by name.

    Args:
        names: of all costs; `cost` is the sum of the others unless it has a range.
        ranges: of those that cost 1 outside of a range, and else nothing.

    Examples:
        >>> highest_costs(["cost", "cost_speed", "cost_height"], ["cost_speed", "cost_height"])
        {'cost_speed': 1.0, 'cost_height': 1.0, 'cost': 2.0}
    """
    highest = {name: 1.0 for name in names if name in ranges}
    kinds = [name for name in names if name != COST]
    if COST not in highest and kinds and all(name in highest for name in kinds):
        highest[COST] = float(len(kinds))
    return highest


def cost_spec(
    highest: float | None, shape: Sequence[int], device: torch.device | None = None
) -> TensorSpec:
    """Spec of a step's cost, float32, from 0 to the most that is known of it, if anything is."""
    if highest is None:
        return Unbounded(shape=shape, device=device)
    return Bounded(0.0, highest, shape=shape, device=device, dtype=torch.float32)
