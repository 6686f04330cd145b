"""Clipped policy losses with a penalty on costs: P3O's exact penalty and IPO's barrier."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from safe_rl.objectives.limit_state import LimitState
from safe_rl.objectives.policy_losses import PPOLoss, clipped_gain


class PenaltyLoss(PPOLoss):
    """PPO with a penalty on the predicted costs, for k constraints.

    `prepare` has to be called with every batch: the penalties need J_c − d and T̄. Costs are
    averaged over the samples for any ``reduction``. Arguments are those of `PPOLoss`.
    """

    has_costs = True

    def _state(self) -> LimitState:
        if self.limits is None:
            raise ValueError(
                f"{type(self).__name__} has no state of the limits yet: call "
                "prepare(batch, limits) with every batch, before its first step."
            )
        return self.limits


class P3OLoss(PenaltyLoss):
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
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import make_actor
        >>> from safe_rl.objectives import LimitState
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> loss = P3OLoss(actor, kappa=20.0, clip_epsilon=0.2, entropy_coeff=0.0)
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"], batch["cost_advantage"] = torch.randn(8, 1), torch.zeros(8, 1)
        >>> state = LimitState.of(cost=[35.0], limit=[25.0], length=100.0)
        >>> losses = loss(loss.prepare(batch, state))
        >>> round(losses["loss_penalty"].item(), 3)  # 20 · 10 / 100
        2.0
    """

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
            "loss_penalty": self.kappa * self._state().excess(surrogates).relu().sum(),
            "cost_surrogate": surrogates.detach(),
        }


def log_barrier(slack: Tensor, kappa: Tensor | float, max_weight: float) -> Tensor:
    """−κ log(slack), continued by its tangent where its slope would exceed ``max_weight``.

    The tangent begins at slack = κ / max_weight, so that value and slope are continuous. The slack
    is the distance to the limit, negative beyond it.

    Examples:
        >>> log_barrier(torch.tensor([1.0, 0.0]), kappa=0.1, max_weight=1.0)
        tensor([-0.0000, 0.3303])
    """
    kappa = torch.as_tensor(kappa).to(slack)
    turn = kappa / max_weight
    inside = -kappa * slack.clamp_min(turn).log()
    outside = -kappa * turn.log() - max_weight * (slack - turn)
    return torch.where(slack > turn, inside, outside)


class IPOLoss(PenaltyLoss):
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
        >>> settings = {"clip_epsilon": 0.2, "entropy_coeff": 0.0}
        >>> loss = IPOLoss(actor, kappa=0.01, max_weight=10.0, **settings)
        >>> "loss_barrier" in loss.out_keys
        True
    """

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
        # before the first batch T̄ is not known
        kappa = (self.kappa / self._state().length.to(surrogates)).nan_to_num(self.kappa)
        return {
            **super()._surrogates(tensordict, log_weight),
            "loss_barrier": log_barrier(
                -self._state().excess(surrogates), kappa, self.max_weight
            ).sum(),
            "cost_surrogate": surrogates.detach(),
        }
