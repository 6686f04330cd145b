"""Loss of CAL, an off-policy algorithm: conservative cost critics, and an augmented Lagrangian."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from annotated_types import Interval
from pydantic import NonNegativeFloat
from tensordict import TensorDictBase
from torch import Tensor

from safe_rl.checks import Weight
from safe_rl.objectives.limits import LimitState
from safe_rl.objectives.sac import SACLagrangianLoss


def discounted_share(gamma: float, episode_length: Tensor) -> Tensor:
    """Ratio of an episode's discounted to its undiscounted cost, for equal costs in all T steps.

    It is (1 − γᵀ) / ((1 − γ) T). The published code multiplies limits by this factor.

    Examples:
        >>> discounted_share(0.99, torch.tensor(1000.0))
        tensor(0.1000)
        >>> discounted_share(1.0, torch.tensor(1000.0))
        tensor(1.)
    """
    if gamma == 1:
        return torch.ones_like(episode_length)
    return (1 - gamma**episode_length) / ((1 - gamma) * episode_length)


class CALLoss(SACLagrangianLoss):
    """SAC on an augmented Lagrangian, with costs that are overestimated on purpose.

    Wu, Tang, Lin, Yu, Mao, Xie, Wang, Wang, *Off-Policy Primal-Dual Safe Reinforcement Learning*
    (ICLR 2024). The cost of an action is Q_i = mean + κ std of an ensemble (conservative policy
    optimisation). Its weight is

        λ̂_i = max(0, λ_i − c (d'_i − E[Q_i]) / u_i)                   (local policy convexification)

    the derivative of (1 / 2c) Σ_i max(0, λ_i + c (E[Q_i] − d'_i) / u_i)² by E[Q_i] / u_i. So near
    the limit the objective is convex in E[Q_i], and the policy converges to the limit instead of
    oscillating about it. The expectation is over a minibatch; u_i is explained in `CostCritics`.

    λ and the limit d are for undiscounted costs of episodes, but E[Q_i] is discounted. The article
    converts d by `discounted_share`. This has an error of some 30 %, because states in a replay
    buffer are from older policies, and costs are not spread evenly. With c = 10, this error shifts
    λ̂ by more than λ can compensate. So d' = ρ d, where ρ is measured: the critics' mean prediction
    (without κ) divided by the mean cost of an episode, both averaged over past batches.

    Args:
        networks: Actor, Q functions and cost Q functions, as in `SACLagrangianLoss`.
        convexity: Penalty coefficient c of the augmented Lagrangian, per unit of discounted cost
            above the limit.
        ratio_memory: Weight of past batches in the moving averages whose ratio is ρ.
        largest_ratio: Largest factor between ρ and `discounted_share`, up or down; 1 for the
            article's conversion.
        settings: Settings of a `SACLagrangianLoss`.

    Attributes:
        discounted_limit: d', [k]; infinite, so that λ̂ is 0, until `prepare` sets it.

    Examples:
        >>> from safe_rl.models import QEnsemble, make_squashed_actor
        >>> from safe_rl.objectives import LagrangeMultiplier
        >>> actor = make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> cost_q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=4, out_key="cost_value")
        >>> multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
        >>> settings = {"convexity": 10.0, "ratio_memory": 0.9, "largest_ratio": 2.0}
        >>> settings |= {"gamma": 0.99, "alpha_init": 0.1, "target_entropy": -2.0}
        >>> loss = CALLoss(
        ...     actor, q, cost_q, multiplier=multiplier, cost_keys=["cost"], **settings
        ... )
        >>> _ = loss.discounted_limit.fill_(2.5)
        >>> values = torch.full((1, 4, 6, 1), 2.7)  # of four networks for six actions
        >>> loss.cost_weights(values)  # 1 + 10 (2.7 - 2.5)
        tensor([3.0000])
    """

    discounted_limit: Tensor
    known_costs: Tensor
    predicted_costs: Tensor

    def __init__(
        self,
        *networks: Any,
        convexity: NonNegativeFloat,
        ratio_memory: Weight,
        largest_ratio: Annotated[float, Interval(ge=1)],
        **settings: Any,
    ) -> None:
        super().__init__(*networks, **settings)
        self.convexity = convexity
        self.ratio_memory, self.largest_ratio = ratio_memory, largest_ratio
        self.out_keys = [*self.out_keys, "cost_weight"]
        zeros = torch.zeros_like(self.cost_unit)
        self.register_buffer("discounted_limit", torch.full_like(zeros, torch.inf))
        # averages over batches: of predicted costs, and of J_c
        self.register_buffer("known_costs", torch.zeros(2, *zeros.shape, device=zeros.device))
        # sum and number of the predictions since the last `prepare`
        self.register_buffer("predicted_costs", torch.zeros(2, *zeros.shape, device=zeros.device))

    def cost_weights(self, values: Tensor) -> Tensor:
        """λ̂ / u, [k]; also adds the critics' mean predictions to the sums for `prepare`."""
        means = self.cost_values.mean(values).flatten(0, -2).mean(0).to(self.predicted_costs)
        self.predicted_costs.add_(torch.stack([means, torch.ones_like(means)]))
        expected = self.cost_of(values).flatten(0, -2).mean(0)
        excess = (expected - self.discounted_limit) / self.cost_unit
        weight = self.multiplier.value.to(excess) + self.convexity * excess
        return weight.clamp_min(0) / self.cost_unit

    def prepare(self, batch: TensorDictBase, limits: LimitState) -> None:
        """Also compute d' from the predictions since the last call, J_c and its target."""
        super().prepare(batch, limits)
        total, number = self.predicted_costs
        expected = discounted_share(self.gamma, limits.length_for(limits.cost))
        if number.any():
            news = torch.stack([total / number, limits.cost])
            self.known_costs.lerp_(news, 1 - self.ratio_memory)
            self.predicted_costs.zero_()
        by_critics, by_episodes = self.known_costs
        ratio = torch.where(by_episodes > 0, by_critics / by_episodes, expected)
        ratio = ratio.clamp(expected / self.largest_ratio, expected * self.largest_ratio)
        self.discounted_limit.copy_(ratio * limits.target)
