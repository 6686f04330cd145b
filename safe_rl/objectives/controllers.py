"""A controller of Lagrange multipliers whose gains have no units.

Violations are measured in units of the limit and bounded, so that a cost of six times the limit
does not charge the integral six times as fast as a cost of 0 empties it. Together with cost
advantages in units of one cost, λ does not depend on the scale of rewards or costs.

Why these two terms. To the multiplier a policy is an integrator: per update, J_c moves by about
β (λ* − λ) limits, λ* being the multiplier that keeps J_c where it is, β ≈ ¼ or less, and no faster
than the trust region lets it. Proportional plus integral control of an integrator has the natural
frequency √(β K_I) and the damping ½ K_P √(β / K_I). An integral alone is undamped: it overshoots
by as much as it was late. K_P = 4 and K_I = 0.4 give a period of 20 updates at a damping of 1.6,
and of 1 where β is a tenth.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from safe_rl.objectives.multipliers import CostLimits, FromZero, Multiplier, per_cost
from safe_rl.ranges import NotNegative, Positive


class PIMultiplier(Multiplier):
    """λ = clip(K_P Δ + I, 0, highest), I ← clip(I + K_I Δ, 0, highest), |Δ| ≤ saturation.

    Δ = (J_c − d) / scale. The integral stops at the bounds of λ, so that it is not wound up beyond
    what it could ever put out (anti-windup by clamping).

    Args:
        cost_limits: mapping from cost key to limit d, or limits alone; see `parse_cost_limits`.
        init: First λ, for all costs or one per cost.
        kp: Proportional gain K_P.
        ki: Integral gain K_I.
        saturation: Bound of the error |Δ|, in units of the limit.
        highest: Upper bound of λ. The reward keeps at least the weight 1 / (1 + highest) in a
            Lagrangian loss with one cost.

    Raises:
        ValueError: if an argument is outside its range.

    Examples:
        >>> multiplier = PIMultiplier(
        ...     {"cost": 25.0}, init=0.0, kp=1.0, ki=0.1, saturation=1.0, highest=5.0
        ... )
        >>> multiplier.update([37.5])
        >>> multiplier.value
        tensor([0.5500])
    """

    scale: Tensor
    integral: Tensor

    def __init__(
        self,
        cost_limits: CostLimits,
        *,
        init: FromZero | Sequence[FromZero],
        kp: NotNegative,
        ki: NotNegative,
        saturation: Positive,
        highest: Positive,
    ) -> None:
        super().__init__(cost_limits)
        if min(kp, ki) < 0 or not saturation > 0 or not highest > 0:
            raise ValueError(
                "kp and ki must not be negative, saturation and highest must be positive; got "
                f"{kp}, {ki}, {saturation} and {highest}."
            )
        initial = per_cost("init", init, self.num_costs)
        if not ((initial >= 0) & (initial <= highest)).all():
            raise ValueError(f"init must lie in [0, highest={highest}], got {initial.tolist()}.")
        self.kp, self.ki, self.saturation, self.highest = kp, ki, saturation, highest
        self.register_buffer("scale", torch.where(self.limits > 0, self.limits, 1.0))
        self.register_buffer("penalty", initial)
        self.register_buffer("integral", initial.clone())

    def set_scale(self, scale: Tensor) -> None:
        """Set the units of violations, [k] > 0: until then the limits, or 1 for a limit of 0."""
        self.scale.copy_(scale)

    def _step(self, mean_costs: Tensor) -> dict[str, Tensor]:
        error = (mean_costs - self.limits) / self.scale
        error = error.clamp(-self.saturation, self.saturation)
        integral = (self.integral + self.ki * error).clamp(0, self.highest)
        penalty = (self.kp * error + integral).clamp(0, self.highest)
        return {"penalty": penalty, "integral": integral}
