"""Lagrange multipliers moved by projected gradient ascent."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from safe_rl.objectives.multipliers import CostLimits, FromZero, Multiplier, per_cost
from safe_rl.ranges import Positive


class ProjectedMultiplier(Multiplier):
    """λ ← clip(λ + α (J_c − d) / u, 0, λ_max), the plain dual ascent.

    Of FOCOPS (Zhang, Vuong and Ross 2020), CUP (Yang et al. 2022) and,
    slow and without λ_max, RCPO (Tessler et al. 2019, algorithm 1). u is the size of one cost: 1,
    as in the articles, unless what λ weighs is in other units (`set_unit`).

    Args:
        cost_limits: mapping from cost key to limit d, or limits alone; see `parse_cost_limits`.
        init: First λ, at most `highest`, for all costs or one per cost.
        lr: Step size α, change of λ per cost of size u in an episode.
        highest: Upper bound λ_max; None for none.

    Raises:
        ValueError: if an initial λ is outside the bounds.

    Examples:
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.0, lr=0.01, highest=2.0)
        >>> multiplier.update([60.0])
        >>> multiplier.value
        tensor([0.3500])
        >>> multiplier.update([1000.0])
        >>> multiplier.value
        tensor([2.])
    """

    unit: Tensor

    def __init__(
        self,
        cost_limits: CostLimits,
        *,
        init: FromZero | Sequence[FromZero],
        lr: Positive,
        highest: Positive | None,
    ) -> None:
        super().__init__(cost_limits)
        self.lr, self.highest = lr, highest
        initial = per_cost("init", init, self.num_costs)
        if not torch.equal(initial.clamp(0, highest), initial):
            raise ValueError(f"init must be between 0 and highest={highest}, got {init}.")
        self.register_buffer("penalty", initial)
        # told anew before every update, and unknown to checkpoints of earlier versions
        self.register_buffer("unit", torch.ones_like(initial), persistent=False)

    def set_unit(self, unit: Tensor) -> None:
        """Set u, [k] > 0."""
        self.unit.copy_(unit)

    def _step(self, mean_costs: Tensor) -> dict[str, Tensor]:
        moved = self.penalty + self.lr * (mean_costs - self.limits) / self.unit
        return {"penalty": moved.clamp(0, self.highest)}
