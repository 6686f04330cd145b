"""Lagrange multipliers that are outputs of PI and PID controllers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from safe_rl.checks import Weight
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.multipliers import CostLimits, FromZero, Multiplier, per_cost


class PIMultiplier(Multiplier):
    """Multiplier from a proportional-integral (PI) controller of the violation.

    λ = clip(K_P Δ + I, 0, highest) and I ← clip(I + K_I Δ, 0, highest), with Δ = (J_c − d) / scale
    and |Δ| ≤ saturation. The scale is `LimitState.scale`, which is d unless d is near 0. The
    integral stops at the bounds of λ (anti-windup by clamping). Without the bound on Δ, a cost of
    six times the limit would raise the integral five times as fast as a cost of 0 lowers it.

    `docs/algorithms/holding_the_limit.md` explains how gains set the period and the damping.

    Args:
        cost_limits: Mapping from cost key to limit d, or limits alone; see `parse_cost_limits`.
        init: Initial λ for all costs or one per cost; at most `highest` counts.
        kp: Proportional gain K_P.
        ki: Integral gain K_I.
        saturation: Bound of the absolute value of the error Δ, in units of the limit.
        highest: Upper bound of λ. The reward keeps at least the weight 1 / (1 + highest) in a
            Lagrangian loss with one cost.

    Examples:
        >>> multiplier = PIMultiplier(
        ...     {"cost": 25.0}, init=0.0, kp=1.0, ki=0.1, saturation=1.0, highest=5.0
        ... )
        >>> multiplier.update(LimitState.of(cost=[37.5], limit=[25.0]))
        >>> multiplier.value
        tensor([0.5500])
    """

    integral: Tensor

    def __init__(
        self,
        cost_limits: CostLimits,
        *,
        init: FromZero | Sequence[FromZero],
        kp: NonNegativeFloat,
        ki: NonNegativeFloat,
        saturation: PositiveFloat,
        highest: PositiveFloat,
    ) -> None:
        super().__init__(cost_limits)
        initial = per_cost("init", init, self.num_costs).clamp(0, highest)
        self.kp, self.ki, self.saturation, self.highest = kp, ki, saturation, highest
        self.register_buffer("penalty", initial)
        self.register_buffer("integral", initial.clone())

    def _step(self, state: LimitState) -> dict[str, Tensor]:
        error = state.violation / state.scale
        error = error.clamp(-self.saturation, self.saturation)
        integral = (self.integral + self.ki * error).clamp(0, self.highest)
        penalty = (self.kp * error + integral).clamp(0, self.highest)
        return {"penalty": penalty, "integral": integral}


class PIDMultiplier(Multiplier):
    """Multiplier from a PID controller (Stooke, Achiam and Abbeel 2020, algorithm 2).

    λ = (K_P Δ + I + K_D ∂)₊. With the error Δ = (J_c − d) / scale, the terms are

    - proportional: Δ, smoothed by an exponential moving average;
    - integral: I ← (I + K_I Δ)₊, with the unsmoothed Δ, in units of λ; it starts at `init`;
    - derivative: ∂ = (J − J')₊, the growth of the smoothed J = J_c / scale over the last
      `derivative_delay` updates. Costs before the first update count as 0, as in the paper.

    Args:
        cost_limits: Mapping from cost key to limit d, or limits alone; see `parse_cost_limits`.
        init: Initial λ, for all costs or one per cost.
        kp: Proportional gain K_P.
        ki: Integral gain K_I.
        kd: Derivative gain K_D.
        proportional_ema: Weight of the past in the smoothed error Δ; 0: not smoothed.
        derivative_ema: Weight of the past in the smoothed cost J; 0: not smoothed.
        derivative_delay: Number of updates over which the growth of the cost is measured.
        scale: Unit of the errors: one number, one per cost, or ``"limit"`` for the limits
            themselves, which makes the gains independent of a cost's units. The paper uses 1.

    Examples:
        >>> gains = {"kp": 0.1, "ki": 0.01, "kd": 0.0, "init": 0.0, "scale": 1.0}
        >>> smoothing = {"proportional_ema": 0.0, "derivative_ema": 0.0, "derivative_delay": 1}
        >>> multiplier = PIDMultiplier({"cost": 25.0}, **gains, **smoothing)
        >>> multiplier.update(LimitState.of(cost=[35.0], limit=[25.0]))
        >>> multiplier.value
        tensor([1.1000])
    """

    scale: Tensor
    integral: Tensor
    smoothed_error: Tensor
    smoothed_cost: Tensor
    past_costs: Tensor

    def __init__(
        self,
        cost_limits: CostLimits,
        *,
        init: FromZero | Sequence[FromZero],
        kp: NonNegativeFloat,
        ki: NonNegativeFloat,
        kd: NonNegativeFloat,
        proportional_ema: Weight,
        derivative_ema: Weight,
        derivative_delay: Annotated[int, Interval(ge=1, le=100_000)],
        scale: PositiveFloat | Sequence[PositiveFloat] | Literal["limit"],
    ) -> None:
        super().__init__(cost_limits)
        initial = per_cost("init", init, self.num_costs)
        scales = self.limits if scale == "limit" else per_cost("scale", scale, self.num_costs)
        if not (scales > 0).all():
            raise ValueError(
                f"scale must be positive, got {scales.tolist()}: a limit of 0 cannot be the unit "
                "of its violations. Set scale to a cost, for example scale=1."
            )
        self.kp, self.ki, self.kd = kp, ki, kd
        self.proportional_ema, self.derivative_ema = proportional_ema, derivative_ema
        self.register_buffer("scale", scales.clone())
        self.register_buffer("penalty", initial)
        self.register_buffer("integral", initial.clone())
        for name in ("smoothed_error", "smoothed_cost"):
            self.register_buffer(name, torch.zeros_like(self.limits))
        self.register_buffer(
            "past_costs", torch.zeros_like(self.limits).repeat(derivative_delay, 1)
        )

    def _step(self, state: LimitState) -> dict[str, Tensor]:
        error = state.violation / self.scale
        smoothed_error = torch.lerp(error, self.smoothed_error, self.proportional_ema)
        integral = (self.integral + self.ki * error).clamp_min(0)
        # of the cost, not of the violation: a target that falls is no growth
        cost = torch.lerp(state.cost / self.scale, self.smoothed_cost, self.derivative_ema)
        growth = (cost - self.past_costs[0]).clamp_min(0)
        penalty = self.kp * smoothed_error + integral + self.kd * growth
        return {
            "penalty": penalty.clamp_min(0),
            "integral": integral,
            "smoothed_error": smoothed_error,
            "smoothed_cost": cost,
            "past_costs": torch.cat([self.past_costs[1:], cost.unsqueeze(0)]),
        }
