"""Clipped policy losses with a penalty on costs: exact (P3O), barrier (IPO), quadratic (APPO)."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat, PositiveFloat
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from safe_rl.objectives.policy_losses import PPOLoss, clipped_gain
from safe_rl.objectives.surrogate import WeighsCosts


class P3OLoss(PPOLoss):
    """PPO with an exact penalty on the clipped cost surrogates, for k constraints.

    Minimises (Zhang et al. 2022, their clipped surrogates with an exact penalty)

        E[−min(ρA, clip(ρ)A)] + κ Σᵢ relu(E[max(ρA_cᵢ, clip(ρ)A_cᵢ)] + (J_cᵢ − dᵢ) / T̄).

    If κ is at least as large as the largest multiplier of the constrained problem, both problems
    have the same solution. The expectation is taken before the relu. The surrogate is an average
    per step. The article's costs and limits are discounted sums, which the factor 1 − γ converts to
    such an average. Here they are undiscounted, so the factor is 1/T̄.

    Adds ``loss_penalty`` and the detached ``cost_surrogate`` [k], E[max(ρA_c, clip(ρ)A_c)].

    Args:
        actor_network: Policy with `get_dist`; see `SurrogateLoss`.
        kappa: Penalty factor κ, for every cost, in units of the standardised reward advantage.
        settings: Those of every clipped loss, see `PPOLoss`; costs are always averaged.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> loss = P3OLoss(actor, kappa=20.0, clip_epsilon=0.2, entropy_coeff=0.0)
        >>> "loss_penalty" in loss.out_keys
        True
    """

    has_costs = True
    extra_out_keys = ("loss_penalty", "clip_fraction", "cost_surrogate")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        kappa: NonNegativeFloat,
        **settings: Any,
    ) -> None:
        super().__init__(actor_network, **settings)
        self.kappa = kappa

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        cost_advantage = self._cost_advantage(tensordict)
        # max(ρA, clip(ρ)A) is −min of the negative advantage
        gain = -clipped_gain(log_weight, -cost_advantage, self.clip_epsilon)
        surrogates = self._cost_surrogates(tensordict, gain)
        return {
            **super()._surrogates(tensordict, log_weight),
            "loss_penalty": self.kappa * self.limits.excess(surrogates).relu().sum(),
            "cost_surrogate": surrogates.detach(),
        }


def log_barrier(slack: Tensor, kappa: Tensor | float, max_weight: float) -> Tensor:
    """−κ log(slack), continued by its tangent where its slope would exceed ``max_weight``.

    The tangent begins at slack = κ / max_weight, so that value and slope are continuous. The slack
    is the distance to the limit, negative beyond it.
    """
    kappa = torch.as_tensor(kappa).to(slack)
    turn = kappa / max_weight
    inside = -kappa * slack.clamp_min(turn).log()
    outside = -kappa * turn.log() - max_weight * (slack - turn)
    return torch.where(slack > turn, inside, outside)


class IPOLoss(PPOLoss):
    """PPO with a logarithmic barrier at every limit, for k constraints.

    Minimises (Liu, Ding and Liu 2020, their logarithmic barrier, with κ = 1/t)

        E[−min(ρA, clip(ρ)A)] − (κ / T̄) Σᵢ log(−cᵢ − E[ρA_cᵢ]),  cᵢ = (J_cᵢ − dᵢ) / T̄.

    The logarithm's argument is the predicted distance to the limit, per step. At a distance
    Δ = d − J_c, the weight of a cost is κ / Δ. Near the limit and beyond it, where the article's
    barrier is not defined, the barrier has the slope `max_weight`, like a multiplier of this size.

    Adds ``loss_barrier`` and the detached ``cost_surrogate`` [k], E[ρA_c].

    Args:
        actor_network: Policy with `get_dist`; see `SurrogateLoss`.
        kappa: Strength κ = 1/t of the barrier, in units of the cost of an episode.
        max_weight: Largest weight of a cost, which it has at the limit and beyond, in units of the
            standardised reward advantage.
        settings: Those of every clipped loss, see `PPOLoss`; costs are always averaged.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> settings = {"max_weight": 10.0, "clip_epsilon": 0.2, "entropy_coeff": 0.0}
        >>> "loss_barrier" in IPOLoss(actor, kappa=0.01, **settings).out_keys
        True
    """

    has_costs = True
    extra_out_keys = ("loss_barrier", "clip_fraction", "cost_surrogate")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        kappa: Annotated[float, Interval(ge=1e-9, le=1e9)],
        max_weight: Annotated[float, Interval(ge=1e-9, le=1e9)],
        **settings: Any,
    ) -> None:
        super().__init__(actor_network, **settings)
        self.kappa, self.max_weight = kappa, max_weight

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        gain = log_weight.exp() * self._cost_advantage(tensordict)
        surrogates = self._cost_surrogates(tensordict, gain)
        kappa = self.kappa / self.limits.length_for(surrogates)
        return {
            **super()._surrogates(tensordict, log_weight),
            "loss_barrier": log_barrier(
                -self.limits.excess(surrogates), kappa, self.max_weight
            ).sum(),
            "cost_surrogate": surrogates.detach(),
        }


class APPOLoss(WeighsCosts, PPOLoss):
    """PPO on an augmented Lagrangian: a quadratic penalty on the predicted violation, and λ.

    Dai, Ji, Yang, Zheng, Pan, *Augmented Proximal Policy Optimization for Safe Reinforcement
    Learning* (AAAI 2023), with the penalty of Nocedal and Wright (2006, section 17.4) for
    inequalities: minimises

        (E[−min(ρA, clip(ρ)A)] + Σᵢ (s/uT̄)ᵢ (max(0, λᵢ + σΔᵢ)² − λᵢ²) / 2σ) / (1 + Σᵢ λᵢ),
        Δᵢ = (J_cᵢ − dᵢ + T̄ E[max(ρA_cᵢ, clip(ρ)A_cᵢ)]) / sᵢ,

    where Δ is the violation that the update itself predicts, in units of s (`LimitState.scale`),
    and u is the size of one cost. So the weight of a cost is max(0, λ + σΔ) / u: it falls while the
    update lowers the cost, and is 0 for a policy that is far enough below its limit.

    Reports ``loss_penalty``, ``clip_fraction``, the detached ``cost_surrogate`` [k] and
    ``cost_weight`` [k], max(0, λ + σΔ).

    Args:
        parts: Actor, and a multiplier with one λ per column of ``cost_advantage``.
        sigma: Penalty coefficient σ: increase of a weight per predicted violation of the size s.
        settings: Those of every clipped loss, see `PPOLoss`; costs are always averaged.

    Examples:
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import ProjectedMultiplier
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> multiplier = ProjectedMultiplier({"cost": 25.0}, init=0.5, lr=0.01, highest=2.0)
        >>> loss = APPOLoss(actor, multiplier, sigma=2.0, clip_epsilon=0.2, entropy_coeff=0.0)
        >>> "cost_weight" in loss.out_keys
        True
    """

    extra_out_keys = ("loss_penalty", "clip_fraction", "cost_surrogate", "cost_weight")

    def __init__(self, *parts: Any, sigma: PositiveFloat, **settings: Any) -> None:
        super().__init__(*parts, **settings)
        self.sigma = sigma

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        state = self.limits
        gain = -clipped_gain(log_weight, -self._cost_advantage(tensordict), self.clip_epsilon)
        scale, unit, length = state.scale.to(gain), state.unit.to(gain), state.length_for(gain)
        surrogates = unit * self._cost_surrogates(tensordict, gain)
        violation = state.excess(surrogates) * length / scale
        multiplier = self.multiplier.value.to(gain)
        weight = (multiplier + self.sigma * violation).clamp_min(0)
        penalty = (weight.square() - multiplier.square()) / (2 * self.sigma)
        penalty = penalty * scale / (unit * length)
        divisor = 1 + multiplier.sum()
        losses = super()._surrogates(tensordict, log_weight)
        return {
            **losses,
            "loss_objective": losses["loss_objective"] / divisor,
            "loss_penalty": penalty.sum() / divisor,
            "cost_surrogate": surrogates.detach(),
            "cost_weight": weight.detach(),
        }

    def _lagrangian(self, tensordict: TensorDictBase, reward_gain: Tensor, ratio: Tensor) -> Tensor:
        return reward_gain  # the costs are in the penalty
