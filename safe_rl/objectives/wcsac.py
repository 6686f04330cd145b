"""Loss of the worst-case soft actor-critic: it limits the tail of the discounted cost."""

from __future__ import annotations

from statistics import NormalDist
from typing import Any

from torch import Tensor
from torch.nn.functional import softplus
from torchrl.objectives.utils import distance_loss

from safe_rl.checks import Fraction
from safe_rl.objectives.risk import CVaR
from safe_rl.objectives.sac import SACLagrangianLoss

_SMALLEST = 1e-8
"""Lower bound of variances, so that their root has a finite slope, as in the published code."""


def gaussian_tail(tail: float) -> float:
    """CVaR_α of a standard Gaussian, α⁻¹ φ(Φ⁻¹(α)): the mean of the largest fraction α in (0, 1].

    Examples:
        >>> round(gaussian_tail(0.5), 4), gaussian_tail(1.0)
        (0.7979, 0.0)
    """
    standard = NormalDist()
    return 0.0 if tail == 1 else standard.pdf(standard.inv_cdf(tail)) / tail


class WCSACLoss(SACLagrangianLoss):
    """SAC on the Lagrangian with CVaR_α of the discounted cost-return instead of its mean.

    Yang, Simão, Tindemans, Spaan, *WCSAC: Worst-Case Soft Actor Critic for Safety-Constrained
    Reinforcement Learning* (AAAI 2021), and *Safety-constrained reinforcement learning with a
    distributional safety critic* (Machine Learning 2023), in its Gaussian form. The cost-return of
    an action is modelled as a Gaussian, with a critic for its mean Q_c and one for its variance
    V_c:

        CVaR_α = Q_c + α⁻¹ φ(Φ⁻¹(α)) √V_c
        Q_c ← c + γ Q_c',   V_c ← c² + 2 γ c Q_c' + γ² (V_c' + Q_c'²) − Q_c²

    The critics' loss is the squared 2-Wasserstein distance of two Gaussians, (Q_c − target)² +
    (√V_c − √target)². With α = 1 it is `SACLagrangianLoss`, and the critic of the variance is not
    used.

    Args:
        networks: Actor, Q functions and cost Q functions, as in `SACLagrangianLoss`. The number of
            cost Q functions is even: the first half are means, the others variances before a
            softplus.
        tail: Share α of the cost-returns, the highest ones, whose mean is limited (CVaR).
        pessimism: Number κ of standard deviations among the CVaR of several pairs of critics that
            is added to their mean.
        settings: Settings of a `SACLagrangianLoss`.

    Raises:
        ValueError: If α is outside (0, 1], or the number of networks is odd.

    Examples:
        >>> import torch
        >>> from safe_rl.models import QEnsemble, make_squashed_actor
        >>> from safe_rl.objectives import LagrangeMultiplier
        >>> actor = make_squashed_actor(3, -torch.ones(2), torch.ones(2), hidden_sizes=[8])
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> cost_q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2, out_key="cost_value")
        >>> multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
        >>> settings = {"tail": 0.5, "gamma": 0.99, "alpha_init": 0.1, "target_entropy": -2.0}
        >>> loss = WCSACLoss(
        ...     actor, q, cost_q, multiplier=multiplier, cost_keys=["cost"], **settings
        ... )
        >>> mean, variance = torch.tensor([[3.0]]), torch.tensor([[3.0]])
        >>> loss.cost_of(torch.stack([mean, variance]))  # 3 + 0.7979 √softplus(3)
        tensor([[4.3931]])
    """

    risk_measure = CVaR

    def __init__(self, *networks: Any, tail: Fraction, **settings: Any) -> None:
        self._factor = gaussian_tail(tail)
        super().__init__(*networks, **settings)
        if (number := self.cost_qvalue_network.num_networks) % 2:
            raise ValueError(
                f"There are {number} cost critics (critics.costs): their number has to be even, a "
                "mean and a variance each."
            )
        self.tail = tail
        self.out_keys = [*self.out_keys, "cost_deviation"]

    def moments(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the cost-return, [E/2, ..., k] each, from outputs [E, ..., k]."""
        mean, variance = values.chunk(2)
        return mean, softplus(variance).clamp_min(_SMALLEST)

    def expected(self, values: Tensor) -> Tensor:
        """Mean of the cost-return of actions, [..., k]."""
        return self.moments(values)[0].mean(0)

    def cost_of(self, values: Tensor) -> Tensor:
        """CVaR_α of the cost-return of actions, [..., k]."""
        mean, variance = self.moments(values)
        return super().cost_of(mean + self._factor * variance.sqrt())

    def moment_targets(
        self, mean: Tensor, costs: Tensor, discount: Tensor, following: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Targets of mean and variance from one step, [E/2, ..., k] each.

        The variance is around `mean`, Q_c of the steps, so differences between successors are a
        part of it. Other arguments are those of `cost_errors`; `following` are mean and variance.
        """
        target = costs + discount * following[0]
        second_moment = target.square() + discount.square() * following[1]
        return target, (second_moment - mean.square()).clamp_min(_SMALLEST)

    def cost_errors(
        self, outputs: Tensor, costs: Tensor, discount: Tensor, following: Tensor
    ) -> Tensor:
        """Squared 2-Wasserstein distance of pairs of critics from their targets, [E/2, ..., k]."""
        mean, variance = self.moments(outputs)
        later_mean, later_variance = self.moments(following)
        later = self.bounded(later_mean), later_variance
        target, spread = self.moment_targets(mean.detach(), costs, discount, later)
        distances = [
            distance_loss(value, goal, loss_function=self.loss_function)
            for value, goal in ((mean, target), (variance.sqrt(), spread.sqrt()))
        ]
        return distances[0] + distances[1]

    def cost_figures(self, values: Tensor) -> dict[str, Tensor]:
        """Means of Q_c and of √V_c, [k] each."""
        mean, variance = self.moments(values)
        return {
            "cost_qvalue": mean.flatten(0, -2).mean(0),
            "cost_deviation": variance.sqrt().flatten(0, -2).mean(0),
        }
