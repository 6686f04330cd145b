"""Lagrange multipliers, one λ per cost: dual ascent, by Adam or plain, and PI and PID controllers.

After every batch a multiplier gets the state of the limits. It increases λ if J_c, the mean
undiscounted cost of an episode, exceeds its target, and decreases λ if not.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat, PositiveFloat
from tensordict import NestedKey
from torch import Tensor, nn
from torch.nn.functional import softplus

from safe_rl.checks import Checked, Weight, check_value
from safe_rl.objectives.limits import LimitState

CostLimits = Mapping[NestedKey, float] | Sequence[float] | float
AboveZero = Annotated[float, Interval(gt=0, le=1e6)]
FromZero = Annotated[float, Interval(ge=0, le=1e6)]


def parse_cost_limits(cost_limits: CostLimits) -> tuple[list[NestedKey], Tensor]:
    """Split limits, undiscounted costs per episode, into keys and a float32 tensor [k].

    Limits that come without keys are named ``cost`` (one) or ``cost_0``, ``cost_1``, … (several).

    Raises:
        ValueError: If there is no limit at all, or one that is below 0 or not a finite number.
    """
    keys: list[NestedKey]
    if isinstance(cost_limits, Mapping):
        keys, values = list(cost_limits.keys()), list(cost_limits.values())
    else:
        values = list(cost_limits) if isinstance(cost_limits, Sequence) else [cost_limits]
        keys = ["cost"] if len(values) == 1 else [f"cost_{i}" for i in range(len(values))]
    if not values:
        raise ValueError(
            "cost_limits is empty: give at least one limit, for example {'cost': 25.0}; "
            "an unconstrained algorithm takes multiplier=None instead."
        )
    check_value("cost_limits", list[NonNegativeFloat], values)
    return keys, torch.tensor(values, dtype=torch.float32)


def per_cost(name: str, value: float | Sequence[float] | Tensor, num_costs: int) -> Tensor:
    """One float32 value per cost, [k], from one for all costs or a sequence of k."""
    tensor = torch.as_tensor(value, dtype=torch.float32)
    if tensor.ndim and tensor.shape != (num_costs,):
        raise ValueError(
            f"{name} must be one number or {num_costs} numbers (one per cost), "
            f"got shape {tuple(tensor.shape)}."
        )
    return tensor.expand(num_costs).clone()


class Multiplier(Checked, nn.Module, ABC):
    """Base of the multipliers: limits, `value` and `update`.

    Subclasses have their state in buffers and implement `_step`. They also implement `value`,
    unless λ is the buffer `penalty`.

    Args:
        cost_limits: Mapping from cost key to limit, or limits alone; see `parse_cost_limits`. λ
            follows the targets that `update` gets, which may be others.

    Attributes:
        cost_keys: One key per cost, in the order of every [k] tensor.
        limits: [k] buffer, undiscounted cost per episode.
    """

    limits: Tensor
    penalty: Tensor

    def __init__(self, cost_limits: CostLimits) -> None:
        super().__init__()
        self.cost_keys, limits = parse_cost_limits(cost_limits)
        self.register_buffer("limits", limits)

    @property
    def num_costs(self) -> int:
        """Number of costs k."""
        return len(self.cost_keys)

    @property
    def value(self) -> Tensor:
        """The multipliers λ ≥ 0, [k], detached."""
        return self.penalty.detach()

    @torch.no_grad()
    def update(self, state: LimitState) -> None:
        """Update λ by what `safe_rl.algorithms.Constraints.update` or `LimitState.of` returns.

        If there is no new estimate of a cost (`is_new` is False, or its violation is NaN), the
        multiplier of this cost and its state do not change.

        Raises:
            TypeError, ValueError: If it is no state of one limit per cost, in order, or λ is < 0.
        """
        if not isinstance(state, LimitState):
            raise TypeError(
                f"update takes a LimitState, got a {type(state).__name__}: what Constraints.update "
                "returns, or LimitState.of(cost=[30.0], limit=[25.0])."
            )
        state.check(self.cost_keys)
        state = state.to(self.limits)
        known = state.violation.isfinite() & state.is_new
        for name, new in self._step(state).items():
            buffer = self.get_buffer(name)
            buffer.copy_(torch.where(known, new, buffer))
        if (self.value < 0).any():
            name, value = type(self).__name__, self.value.tolist()
            raise ValueError(f"{name}: λ must not be below 0, which rewards costs; got {value}.")

    @abstractmethod
    def _step(self, state: LimitState) -> dict[str, Tensor]:
        """Return the new value of every state buffer, [..., k]."""


class LagrangeMultiplier(Multiplier):
    """Multiplier λ = softplus(ν), where Adam updates ν with the dual loss −ν·(J_c − d).

    The gradient is taken with respect to ν directly, not through the softplus, as in the
    Lagrangian baselines of Ray, Achiam and Amodei, *Benchmarking Safe Exploration in Deep
    Reinforcement Learning* (2019), section 5.1. Adam (Kingma and Ba 2015, algorithm 1) is part of
    this class, so that its moments are buffers, which are saved and moved between devices.

    Args:
        cost_limits: Mapping from cost key to limit d, or limits alone; see `parse_cost_limits`.
        init: Initial λ, for all costs or one per cost; above 0, because a softplus is never 0.
        lr: Step size of Adam.

    Examples:
        >>> multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
        >>> multiplier.update(LimitState.of(cost=[60.0], limit=[25.0]))
        >>> multiplier.value
        tensor([1.0319])
    """

    nu: Tensor
    step: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor

    def __init__(
        self, cost_limits: CostLimits, *, init: AboveZero | Sequence[AboveZero], lr: PositiveFloat
    ) -> None:
        super().__init__(cost_limits)
        initial = per_cost("init", init, self.num_costs)
        self.lr = lr
        # softplus⁻¹(λ) = log(exp(λ) − 1), in the form that does not overflow.
        self.register_buffer("nu", initial + torch.log(-torch.expm1(-initial)))
        for name in ("step", "exp_avg", "exp_avg_sq"):
            self.register_buffer(name, torch.zeros_like(self.limits))

    @property
    def value(self) -> Tensor:
        """The multipliers λ = softplus(ν) > 0, [k], detached."""
        return softplus(self.nu).detach()

    def _step(self, state: LimitState) -> dict[str, Tensor]:
        beta1, beta2 = 0.9, 0.999
        grad = -state.violation
        step = self.step + 1
        exp_avg = torch.lerp(grad, self.exp_avg, beta1)
        exp_avg_sq = torch.lerp(grad.square(), self.exp_avg_sq, beta2)
        denominator = (exp_avg_sq / (1 - beta2**step)).sqrt() + 1e-8
        nu = self.nu - self.lr * exp_avg / (1 - beta1**step) / denominator
        return {"nu": nu, "step": step, "exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}


class ProjectedMultiplier(Multiplier):
    """Multiplier by projected gradient ascent: λ ← clip(λ + α (J_c − d) / u, 0, λ_max).

    FOCOPS (Zhang, Vuong and Ross 2020) and CUP (Yang et al. 2022) use it; with a small α and
    without λ_max, so does RCPO (Tessler et al. 2019, algorithm 1). u is the typical size of one
    cost, by which losses divide λ; it is 1 for costs of 0 or 1, and in the articles.

    Args:
        cost_limits: Mapping from cost key to limit d, or limits alone; see `parse_cost_limits`.
        init: Initial λ for all costs or one per cost; at most `highest` counts.
        lr: Step size α: change of λ per epoch if J_c is above its limit by the size u of one cost.
        highest: Upper bound λ_max of λ; None: no bound.

    Examples:
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.0, lr=0.01, highest=2.0)
        >>> multiplier.update(LimitState.of(cost=[60.0], limit=[25.0]))
        >>> multiplier.value
        tensor([0.3500])
    """

    def __init__(
        self,
        cost_limits: CostLimits,
        *,
        init: FromZero | Sequence[FromZero],
        lr: PositiveFloat,
        highest: AboveZero | None,
    ) -> None:
        super().__init__(cost_limits)
        self.lr, self.highest = lr, highest
        self.register_buffer("penalty", per_cost("init", init, self.num_costs).clamp(0, highest))

    def _step(self, state: LimitState) -> dict[str, Tensor]:
        moved = self.penalty + self.lr * state.violation / state.unit
        return {"penalty": moved.clamp(0, self.highest)}


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
        highest: AboveZero,
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
        past = torch.zeros_like(self.limits).repeat(derivative_delay, 1)
        self.register_buffer("past_costs", past)

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
