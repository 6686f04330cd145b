"""Penalised proximal policy optimisation (Zhang, Shen, Yang, Chen, Wang, Yuan and Tao 2022)."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor

from safe_rl.objectives.ppo import PPOLoss, clipped_gain
from safe_rl.objectives.violation import Violations, violation_of
from safe_rl.ranges import NotNegative, Share


class P3OLoss(PPOLoss):
    """PPO with an exact penalty on the clipped cost surrogates, for k constraints.

    Minimises (Zhang et al. 2022, their clipped surrogates with an exact penalty)

        E[−min(ρA, clip(ρ)A)] + κ Σᵢ relu(E[max(ρA_cᵢ, clip(ρ)A_cᵢ)] + (1 − γ)(J_cᵢ − dᵢ)).

    With κ at least as large as the largest multiplier of the constrained problem, both have the
    same solution. The expectation is taken before the relu. 1 − γ turns a sum that is discounted
    by γ into an average per step, which is what the surrogate is; the limits here are on
    undiscounted sums, whose average is reached by 1/T̄: ``gamma=None``.

    Reads and writes what `PPOLoss` does, reads ``cost_advantage`` [..., k], and adds
    ``loss_penalty`` and the detached ``cost_surrogate`` [k], E[max(ρA_c, clip(ρ)A_c)].

    Args:
        actor_network: policy with `get_dist`; see `SurrogateLoss`.
        constraints: where J_c − d and T̄ stand at every call.
        kappa: Penalty factor κ, for every cost, in units of the standardised reward advantage.
        gamma: Discount γ in the factor 1 − γ of the violation; None takes 1/T̄ in its place.
        settings: Those of every clipped loss, see `PPOLoss`; costs are always averaged.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from safe_rl.algorithms import Constraints
        >>> from safe_rl.models import make_actor
        >>> actor = make_actor(3, 2, hidden_sizes=[16], initial_log_std=-0.5)
        >>> constraints = Constraints({"cost": 25.0})
        >>> constraints.violation.fill_(10.0)  # a recipe's constraints observe their episodes
        tensor([10.])
        >>> settings = {"clip_epsilon": 0.2, "entropy_coeff": 0.0}
        >>> loss = P3OLoss(actor, constraints, kappa=20.0, gamma=0.99, **settings)
        >>> with torch.no_grad():
        ...     batch = actor(TensorDict(observation=torch.randn(8, 3), batch_size=[8]))
        >>> batch["advantage"], batch["cost_advantage"] = torch.randn(8, 1), torch.zeros(8, 1)
        >>> round(loss(batch)["loss_penalty"].item(), 3)  # 20 (1 - 0.99) 10
        2.0
    """

    extra_out_keys = ("loss_penalty", "clip_fraction", "cost_surrogate")
    has_costs = True

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        constraints: Violations,
        *,
        kappa: NotNegative,
        gamma: Share | None,
        **settings: Any,
    ) -> None:
        super().__init__(actor_network, **settings)
        self.constraints, self.kappa, self.gamma = constraints, kappa, gamma

    def _surrogates(self, tensordict: TensorDictBase, log_weight: Tensor) -> dict[str, Tensor]:
        cost_advantage = self._cost_advantage(tensordict)
        # max(ρA, clip(ρ)A) is −min of the negative advantage
        gain = -clipped_gain(log_weight, -cost_advantage, self.clip_epsilon)
        surrogates = self._cost_surrogates(tensordict, gain)
        violation = violation_of(self.constraints, surrogates)
        # no episode has a length before the first batch, when the violation counts as 0
        inverse = (1 / self.constraints.episode_length).nan_to_num(0.0)
        per_step = inverse if self.gamma is None else 1 - self.gamma
        excess = surrogates + per_step * violation
        return {
            **super()._surrogates(tensordict, log_weight),
            "loss_penalty": self.kappa * excess.relu().sum(),
            "cost_surrogate": surrogates.detach(),
        }
