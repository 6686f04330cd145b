"""What is known about the limits after a batch, for multipliers, losses and steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class LimitState:
    """The state of k limits after a batch: `safe_rl.algorithms.Constraints.update` returns it.

    NaN means that nothing is known yet. Then multipliers stay as they are, and losses and steps
    assume that the policy is exactly at its limits.

    Attributes:
        cost: J_c, undiscounted cost per episode, [k].
        target: Present upper bound of J_c, [k]: d, or another value while the limit falls.
        length: T̄, mean number of time steps of an episode, scalar.
        unit: Typical size of one cost, [k]; see `EpisodeCosts.unit`. Losses weigh costs by
            λ / unit.
        scale: Unit of violations for controllers, [k]: d, or a larger value for limits near 0.
        realised_share: Share of a predicted change of J_c that is observed, [k].
        integral: Weighted sum of earlier violations, which steps add to the present one, [k].
        is_new: Whether the batch has changed `cost`. If not, multipliers stay as they are.

    Examples:
        >>> state = LimitState.of(cost=[30.0], limit=[25.0], length=1000.0)
        >>> state.violation, state.required_decrease
        (tensor([5.]), tensor([5.]))
    """

    cost: Tensor
    target: Tensor
    length: Tensor
    unit: Tensor
    scale: Tensor
    realised_share: Tensor
    integral: Tensor
    is_new: bool = True

    @classmethod
    def of(
        cls,
        *,
        cost: Tensor | Sequence[float],
        limit: Tensor | Sequence[float],
        length: Tensor | float = torch.nan,
        is_new: bool = True,
    ) -> LimitState:
        """The state without a tracker: the target is the limit d, and costs have the unit 1."""
        limit = torch.as_tensor(limit, dtype=torch.float32)
        cost = torch.as_tensor(cost).to(limit)
        return cls(
            cost=cost,
            target=limit,
            length=torch.as_tensor(length).to(limit),
            unit=torch.ones_like(limit),
            scale=torch.where(limit > 0, limit, 1.0),
            realised_share=torch.ones_like(limit),
            integral=torch.zeros_like(limit),
            is_new=is_new,
        )

    @property
    def violation(self) -> Tensor:
        """J_c − target, [k]."""
        return self.cost - self.target

    @property
    def required_decrease(self) -> Tensor:
        """Decrease of J_c that a step's surrogate must predict, [k]; if negative, J_c may rise.

        Violation plus integral. If only a share of predicted decreases is observed, the prediction
        has to be larger accordingly.
        """
        change = self.violation + self.integral
        return torch.where(change > 0, change / self.realised_share, change)

    def required_decrease_for(self, surrogates: Tensor) -> Tensor:
        """`required_decrease` with the dtype and device of cost surrogates [k], and 0 for NaN.

        Raises:
            ValueError: If there is not one limit per surrogate.
        """
        decrease = self.required_decrease
        if decrease.shape != surrogates.shape:
            raise ValueError(
                f"There are {surrogates.numel()} cost surrogate(s) and {decrease.numel()} limits: "
                "cost_advantage needs one column per limit."
            )
        return decrease.to(surrogates).nan_to_num(nan=0.0)

    def excess(self, surrogates: Tensor) -> Tensor:
        """Predicted amount above the target, per time step, [k], from cost surrogates [k].

        A surrogate is an average per time step, so the required decrease of an episode's cost is
        divided by the episode's length.
        """
        decrease = self.required_decrease_for(surrogates)
        return surrogates + (decrease / self.length.to(surrogates)).nan_to_num(nan=0.0)

    def to(self, device: torch.device) -> LimitState:
        """The same on another device."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        tensors = {k: v.to(device) for k, v in values.items() if isinstance(v, Tensor)}
        return replace(self, **tensors)
