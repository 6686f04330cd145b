"""Lagrange multipliers, one λ per cost: dual ascent by Adam or by plain gradient steps.

Once per epoch a multiplier gets the violations J_c − d, where J_c is the mean undiscounted cost of
an episode. It increases λ if J_c exceeds its limit d, and decreases λ if not. Its whole state is in
buffers. `safe_rl.objectives.controllers` has multipliers that are PI and PID controllers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated

import torch
from annotated_types import Interval
from pydantic import PositiveFloat
from tensordict import NestedKey
from torch import Tensor, nn
from torch.nn.functional import softplus

from safe_rl.checks import Checked

CostLimits = Mapping[NestedKey, float] | Sequence[float] | float
AboveZero = Annotated[float, Interval(gt=0, le=1e6)]
FromZero = Annotated[float, Interval(ge=0, le=1e6)]


def parse_cost_limits(cost_limits: CostLimits) -> tuple[list[NestedKey], Tensor]:
    """Split cost limits into keys and a tensor.

    Args:
        cost_limits: A mapping from cost key to limit, a sequence of limits, or one limit. The
            limits are undiscounted costs per episode.

    Returns:
        The cost keys, and the limits as a float32 tensor [k]. Limits that come without keys
        are named ``cost`` (one) or ``cost_0``, ``cost_1``, … (several).

    Raises:
        ValueError: If there is no limit at all, or one that is not a finite number.
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
    limits = torch.as_tensor(values, dtype=torch.float32)
    if not limits.isfinite().all():
        raise ValueError(f"cost_limits must be finite numbers, got {values}.")
    return keys, limits


def per_cost(name: str, value: float | Sequence[float] | Tensor, num_costs: int) -> Tensor:
    """Expand a scalar, or check a sequence, to one float32 value per cost, [k].

    Raises:
        ValueError: If a sequence does not hold one value per cost.
    """
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
        cost_limits: Mapping from cost key to limit, or limits alone; see `parse_cost_limits`.

    Raises:
        TypeError: If a subclass has no `_step`.

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
    def update(self, violation: Tensor | Sequence[float] | float) -> None:
        """Update λ after an epoch.

        If a violation is not finite (NaN: no episode finished in the epoch), the multiplier of this
        cost and its state do not change.

        Args:
            violation: J_c − d, [k] (or a scalar if k = 1): mean undiscounted cost of an episode
                minus its limit or target.

        Raises:
            ValueError: If there is not one number per cost.
        """
        given = torch.as_tensor(violation, dtype=self.limits.dtype, device=self.limits.device)
        if given.numel() != self.num_costs:
            raise ValueError(
                f"update() needs one violation for each of {self.cost_keys}, "
                f"got shape {tuple(given.shape)}."
            )
        given = given.reshape(self.num_costs)
        known = given.isfinite()
        for name, new in self._step(torch.where(known, given, 0.0)).items():
            buffer = self.get_buffer(name)
            buffer.copy_(torch.where(known, new, buffer))

    def set_scale(self, scale: Tensor) -> None:
        """Set the units of violations, [k] > 0; most multipliers ignore this."""

    def set_unit(self, unit: Tensor) -> None:
        """Set the typical size u of one cost, [k] > 0; some multipliers divide violations by it."""

    def set_target(self, target: Tensor) -> None:
        """Set the target that violations are measured from, [k]; most multipliers ignore this."""

    @abstractmethod
    def _step(self, violation: Tensor) -> dict[str, Tensor]:
        """Return the new value of every state buffer ([..., k]) given finite J_c − d, [k]."""


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
        >>> multiplier.update(torch.tensor([35.0]))  # J_c = 60
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
            self.register_buffer(name, torch.zeros(self.num_costs))

    @property
    def value(self) -> Tensor:
        """The multipliers λ = softplus(ν) > 0, [k], detached."""
        return softplus(self.nu).detach()

    def _step(self, violation: Tensor) -> dict[str, Tensor]:
        beta1, beta2 = 0.9, 0.999
        grad = -violation
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
    cost: 1, as in the articles, unless cost advantages have been divided by it (`set_unit`).

    Args:
        cost_limits: Mapping from cost key to limit d, or limits alone; see `parse_cost_limits`.
        init: Initial λ, at most `highest`, for all costs or one per cost.
        lr: Step size α: change of λ per epoch if J_c is above its limit by the size u of one cost.
        highest: Upper bound λ_max of λ; None: no bound.

    Examples:
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.0, lr=0.01, highest=2.0)
        >>> multiplier.update([35.0])  # J_c = 60
        >>> multiplier.value
        tensor([0.3500])
        >>> multiplier.update([975.0])
        >>> multiplier.value
        tensor([2.])
    """

    unit: Tensor

    def __init__(
        self,
        cost_limits: CostLimits,
        *,
        init: FromZero | Sequence[FromZero],
        lr: PositiveFloat,
        highest: PositiveFloat | None,
    ) -> None:
        super().__init__(cost_limits)
        self.lr, self.highest = lr, highest
        self.register_buffer("penalty", per_cost("init", init, self.num_costs))
        # set before every update: checkpoints need not hold it
        self.register_buffer("unit", torch.ones_like(self.limits), persistent=False)

    def set_unit(self, unit: Tensor) -> None:
        """Set u, [k] > 0."""
        self.unit.copy_(unit)

    def _step(self, violation: Tensor) -> dict[str, Tensor]:
        moved = self.penalty + self.lr * violation / self.unit
        return {"penalty": moved.clamp(0, self.highest)}
