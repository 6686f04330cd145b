"""What the numbers of a cost critic mean: a mean, a mean and a variance, or quantiles.

A cost critic estimates the discounted cost that follows an action. It returns n numbers per cost. A
`CostValues` says how many, how they become one cost for the policy's loss (the mean, or the mean of
the tail), and how they are learned.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from statistics import NormalDist
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from pydantic import PositiveFloat
from torch import Tensor
from torch.nn.functional import mse_loss, softplus

from safe_rl.checks import Checked, Fraction

_SMALLEST = 1e-8
"""Lower bound of variances, so that their root has a finite slope, as in the published code."""


Bounds = Callable[[Tensor], Tensor]
"""Applies pessimism and bounds to costs [E, ...] to bootstrap on."""


class CostValues(Checked, ABC):
    """The numbers that critics return for k costs of an action, [n, E, ..., k].

    A critic consists of `networks` perceptrons, each of which returns `outputs` numbers per cost.

    Attributes:
        networks: Perceptrons per critic; n is ``networks * outputs``.
        outputs: Numbers per cost and perceptron.
        columns: Names of diagnostics besides ``cost_qvalue``.
    """

    networks: int = 1
    outputs: int = 1
    columns: ClassVar[tuple[str, ...]] = ()

    def arranged(self, values: Tensor, num_costs: int) -> Tensor:
        """[n, E, ..., k] from the outputs [networks · E, ..., k · outputs] of an ensemble."""
        by_network = values.unflatten(0, (self.networks, -1))
        return by_network.unflatten(-1, (num_costs, self.outputs)).movedim(-1, 1).flatten(0, 1)

    @abstractmethod
    def mean(self, values: Tensor) -> Tensor:
        """Expected discounted costs, [E, ..., k], from numbers [n, E, ..., k]."""

    def cost(self, values: Tensor) -> Tensor:
        """Costs as the policy's loss weighs them, [E, ..., k], from numbers [n, E, ..., k]."""
        return self.mean(values)

    @abstractmethod
    def errors(
        self, values: Tensor, costs: Tensor, discount: Tensor, following: Tensor, bounded: Bounds
    ) -> Tensor:
        """Distances of the numbers from their TD(0) targets, [E, ..., k].

        Args:
            values: Numbers for the steps, [n, E, ..., k].
            costs: Costs of the steps, [..., k].
            discount: Discount of the next state's value, 0 if the episode terminated, [..., 1].
            following: Numbers of the target networks in the next state, [n, E, ..., k].
            bounded: Is applied to the costs to bootstrap on.
        """

    def figures(self, values: Tensor) -> dict[str, Tensor]:
        """Diagnostics of numbers [n, E, ..., k] by name, [E, ..., k] each."""
        return {}


class MeanCosts(CostValues):
    """One number per cost, its mean.

    Examples:
        >>> MeanCosts().cost(torch.tensor([[3.0, 1.0]]))  # of two critics
        tensor([3., 1.])
    """

    def mean(self, values: Tensor) -> Tensor:
        """The only number."""
        return values.squeeze(0)

    def errors(
        self, values: Tensor, costs: Tensor, discount: Tensor, following: Tensor, bounded: Bounds
    ) -> Tensor:
        """Distances of the means from c + γ Q'; see `CostValues`."""
        target = costs + discount * bounded(self.mean(following))
        return mse_loss(self.mean(values), target, reduction="none")


def gaussian_tail(tail: float) -> float:
    """CVaR_α of a standard Gaussian, α⁻¹ φ(Φ⁻¹(α)): the mean of the largest fraction α."""
    standard = NormalDist()
    return 0.0 if tail == 1 else standard.pdf(standard.inv_cdf(tail)) / tail


class GaussianCosts(CostValues):
    """Mean and variance of each cost, from two perceptrons, and CVaR_α of a Gaussian of these.

    Yang, Simão, Tindemans, Spaan, *WCSAC: Worst-Case Soft Actor Critic for Safety-Constrained
    Reinforcement Learning* (AAAI 2021), and *Safety-constrained reinforcement learning with a
    distributional safety critic* (Machine Learning 2023), in its Gaussian form:

        CVaR_α = Q_c + α⁻¹ φ(Φ⁻¹(α)) √V_c
        Q_c ← c + γ Q_c',   V_c ← c² + 2 γ c Q_c' + γ² (V_c' + Q_c'²) − Q_c²

    The loss is the squared 2-Wasserstein distance of two Gaussians, (Q_c − target)² + (√V_c −
    √target)². A variance is the softplus of its perceptron. With α = 1 the cost is the mean.

    Args:
        tail: Share α of the cost-returns, the highest ones, whose mean is limited (CVaR).

    Examples:
        >>> mean_and_variance = torch.tensor([[3.0], [3.0]])  # the variance before a softplus
        >>> GaussianCosts(tail=0.5).cost(mean_and_variance)  # 3 + 0.7979 √softplus(3)
        tensor([4.3931])
    """

    networks = 2
    columns = ("cost_deviation",)

    def __init__(self, *, tail: Fraction) -> None:
        self.tail, self._factor = tail, gaussian_tail(tail)

    def moments(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance, [E, ..., k] each."""
        mean, variance = values.unbind()
        return mean, softplus(variance).clamp_min(_SMALLEST)

    def mean(self, values: Tensor) -> Tensor:
        """The first number."""
        return values[0]

    def cost(self, values: Tensor) -> Tensor:
        """CVaR_α, [E, ..., k]."""
        mean, variance = self.moments(values)
        return mean + self._factor * variance.sqrt()

    def moment_targets(
        self, mean: Tensor, costs: Tensor, discount: Tensor, following: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Targets of mean and variance from one step, [E, ..., k] each.

        The variance is around `mean`, Q_c of the steps, so differences between successors are a
        part of it. `following` are mean and variance in the next state.
        """
        target = costs + discount * following[0]
        second_moment = target.square() + discount.square() * following[1]
        return target, (second_moment - mean.square()).clamp_min(_SMALLEST)

    def errors(
        self, values: Tensor, costs: Tensor, discount: Tensor, following: Tensor, bounded: Bounds
    ) -> Tensor:
        """Squared 2-Wasserstein distances; see `CostValues`."""
        mean, variance = self.moments(values)
        later_mean, later_variance = self.moments(following)
        later = bounded(later_mean), later_variance
        target, spread = self.moment_targets(mean.detach(), costs, discount, later)
        distances = [
            mse_loss(value, goal, reduction="none")
            for value, goal in ((mean, target), (variance.sqrt(), spread.sqrt()))
        ]
        return distances[0] + distances[1]

    def figures(self, values: Tensor) -> dict[str, Tensor]:
        """The deviation √V_c."""
        return {"cost_deviation": self.moments(values)[1].sqrt()}


class QuantileCosts(CostValues):
    """N quantiles of each cost, learned by quantile regression, and the mean of the highest ones.

    Dabney, Rowland, Bellemare, Munos, *Distributional Reinforcement Learning with Quantile
    Regression* (AAAI 2018). Quantile i is that of the level τ_i = (i − ½) / N. Each is compared
    with all target quantiles c + γ q_j' by their equation 10, divided by κ: the Huber loss of the
    difference, weighed by τ_i or 1 − τ_i.

    Args:
        number: Number N of quantiles.
        tail: Share α of the discounted costs, the highest ones, whose mean (CVaR) is the cost; 1:
            all of them, which is the mean.
        huber: Difference, in units of discounted cost, from which the loss is linear.

    Examples:
        >>> quantiles = torch.tensor([[4.0], [1.0], [3.0], [2.0]])
        >>> QuantileCosts(number=4, tail=0.5, huber=1.0).cost(quantiles)
        tensor([3.5000])
    """

    columns = ("cost_deviation",)

    def __init__(
        self,
        *,
        number: Annotated[int, Interval(ge=2, le=1000)],
        tail: Fraction,
        huber: PositiveFloat,
    ) -> None:
        self.outputs, self.tail, self.huber = number, tail, huber

    def mean(self, values: Tensor) -> Tensor:
        """The mean of the quantiles."""
        return values.mean(0)

    def cost(self, values: Tensor) -> Tensor:
        """The mean of the highest share α, [E, ..., k]; a quantile at its edge counts in part."""
        if self.tail == 1:
            return self.mean(values)
        number = self.tail * self.outputs
        weights = (number - torch.arange(self.outputs, device=values.device)).clamp(0, 1) / number
        highest = values.sort(0, descending=True).values
        return torch.tensordot(weights.to(values), highest, 1)

    def errors(
        self, values: Tensor, costs: Tensor, discount: Tensor, following: Tensor, bounded: Bounds
    ) -> Tensor:
        """Huber losses of the quantiles; see `CostValues`."""
        later = bounded(following.movedim(0, -1))  # each quantile of its own
        targets = costs.unsqueeze(-1) + discount.unsqueeze(-1) * later
        change = targets.unsqueeze(-2) - values.movedim(0, -1).unsqueeze(-1)  # [E, ..., k, N, N]
        size = change.abs()
        inside = size.clamp_max(self.huber)
        loss = inside * (size - inside / 2) / self.huber
        levels = (torch.arange(self.outputs, device=values.device) + 0.5) / self.outputs
        weight = (levels[:, None].to(values) - (change < 0).to(values)).abs()
        return (weight * loss).mean(-1).sum(-1)

    def figures(self, values: Tensor) -> dict[str, Tensor]:
        """The standard deviation of the quantiles."""
        return {"cost_deviation": values.std(0, correction=0)}
