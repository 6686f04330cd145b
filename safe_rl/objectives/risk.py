"""Limits on other measures than the mean: CVaR, and the share of episodes above a limit.

With a limit d on the mean cost, a third to a half of the episodes cost more than d. A risk measure
replaces the costs of steps by *measured costs*. The mean over episodes of their sum is the measure,
up to an offset. So the estimates of J_c, the target and the multiplier are those of the measure.

The policy learns from the costs themselves, and the measure only says how strongly. The CVaR's own
gradient comes from the few steps of its tail, two episodes of a batch of twenty: with it none of
four runs kept a limit (`docs/guides/limits.md`).

A step has a measured cost if the cost of its episode up to this step passes a threshold. So the
measure needs the cost of unfinished episodes at the start of a batch, but no batches of whole
episodes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, NamedTuple

import torch
from annotated_types import Interval
from torch import Tensor

from safe_rl.checks import Checked, Fraction, Weight
from safe_rl.resumable import Resumable


class MeasuredCosts(NamedTuple):
    """The values that replace the costs of a batch where J_c is estimated."""

    costs: Tensor  # of its steps, [N, T, k]
    offset: Tensor  # is added to their sum over an episode, [k]
    limit: Tensor  # of the mean of this total over episodes, [k]


class RiskMeasure(Checked, Resumable, ABC):
    """A measure of episode costs that is limited instead of their mean.

    If they depend on earlier batches, ``state_names`` names the attributes to save.

    Attributes:
        limits: Limits d, [k].
    """

    limits: Tensor

    @property
    def measured_limits(self) -> Tensor:
        """Limit of the mean measured cost of an episode, [k]."""
        return self.limits

    @abstractmethod
    def __call__(
        self, costs: Tensor, ends: Tensor, before: Tensor, finished: Tensor
    ) -> MeasuredCosts:
        """Compute the measured costs of a batch.

        Args:
            costs: Costs of its steps, [N, T, k], none negative.
            ends: Whether an episode ends with a step, [N, T] bool.
            before: Cost of the unfinished episodes before the first step, [N, k].
            finished: Costs of the episodes that finished, [E, k].
        """


def value_at_risk(costs: Tensor, tail: float) -> Tensor:
    """The cost that at most a fraction `tail` of the episodes exceeds: [E, k] -> [k]."""
    ranked = costs.sort(0, descending=True).values
    return ranked[min(int(tail * len(ranked)), len(ranked) - 1)]


def cost_so_far(costs: Tensor, ends: Tensor, before: Tensor) -> Tensor:
    """Cost of the episode up to and with each step, [N, T, k]; arguments as of `RiskMeasure`."""
    # in double precision, so that an episode without costs has a cost of exactly 0
    total = costs.double().cumsum(1) + before.unsqueeze(1)
    closed = torch.where(ends.unsqueeze(-1), total, 0).roll(1, 1)
    closed[:, 0] = 0
    return (total - closed.cummax(1).values).to(costs)


class CVaR(RiskMeasure):
    """CVaR_α ≤ d: the mean cost of the worst fraction α of the episodes.

    With the cost C of an episode, CVaR = ν + E[(C − ν)₊] / α. ν is the value at risk: a fraction α
    of the episodes costs more (Rockafellar and Uryasev 2000, theorem 1). The measured cost of a
    step is the increase of (C − ν)₊ / α by this step; until an episode has finished, it is the
    cost.

    A limit on the CVaR must be higher than one on the mean: the package's policy for PointGoal1
    has a mean of 24 and, at α = 0.1, a CVaR of 89.

    Args:
        cost_limits: Limits d, [k].
        tail: Share α of the episodes, those with the highest costs, whose mean cost is limited.
        window: Number of past episodes from which ν, the value at risk, is estimated.

    Examples:
        >>> risk = CVaR(torch.tensor([50.0]), tail=0.5, window=100)
        >>> costs, ends = torch.ones(2, 3, 1), torch.tensor([[False, False, True]] * 2)
        >>> finished = torch.tensor([[3.0], [13.0]])
        >>> measured = risk(costs, ends, torch.tensor([[0.0], [10.0]]), finished)
        >>> measured.costs.sum((1, 2)), measured.offset  # ν = 3
        (tensor([0., 6.]), tensor([3.]))
    """

    state_names = ("_finished",)

    def __init__(
        self,
        cost_limits: Tensor,
        *,
        tail: Fraction,
        window: Annotated[int, Interval(ge=1, le=10**6)],
    ) -> None:
        self.limits = cost_limits.detach().cpu().float()
        self.tail, self.window = tail, window
        self._finished = torch.empty(0, len(self.limits))

    def __call__(
        self, costs: Tensor, ends: Tensor, before: Tensor, finished: Tensor
    ) -> MeasuredCosts:
        """Compute the measured costs of a batch: see `RiskMeasure`."""
        self._finished = torch.cat([self._finished, finished.float()])[-self.window :]
        if not len(self._finished):
            return MeasuredCosts(costs, torch.zeros_like(self.limits), self.limits)
        threshold = value_at_risk(self._finished, self.tail)
        beyond = (cost_so_far(costs, ends, before) - threshold).clamp_min(0)
        return MeasuredCosts(torch.minimum(costs, beyond) / self.tail, threshold, self.limits)


class Chance(RiskMeasure):
    """P(C > d) ≤ ε: at most a fraction ε of the episodes costs more than d.

    The step at which an episode's cost passes d has the measured cost w = max(d, 1), all others 0.
    Their sum over an episode is w 1{C > d}, and the limit of its mean is w ε. With the weight w, λ
    has about the same size as for a limit on the mean cost.

    Args:
        cost_limits: Limits d, [k].
        most_over: Share ε of episodes that may exceed the limit.

    Examples:
        >>> risk = Chance(torch.tensor([2.0]), most_over=0.1)
        >>> costs, ends = torch.ones(1, 4, 1), torch.tensor([[False, False, False, True]])
        >>> risk(costs, ends, torch.zeros(1, 1), torch.tensor([[4.0]])).costs.flatten()
        tensor([0., 0., 2., 0.])
    """

    def __init__(self, cost_limits: Tensor, *, most_over: Weight) -> None:
        self.limits = cost_limits.detach().cpu().float()
        self.weight = self.limits.clamp_min(1.0)
        self.most_over = most_over

    @property
    def measured_limits(self) -> Tensor:
        """Limit of the mean measured cost of an episode, w ε, [k]."""
        return self.weight * self.most_over

    def __call__(
        self, costs: Tensor, ends: Tensor, before: Tensor, finished: Tensor
    ) -> MeasuredCosts:
        """Compute the measured costs of a batch: see `RiskMeasure`."""
        over = cost_so_far(costs, ends, before) > self.limits
        was_over = (over & ~ends.unsqueeze(-1)).roll(1, 1)
        was_over[:, 0] = before > self.limits
        crossing = torch.where(over & ~was_over, self.weight, 0.0).to(costs)
        return MeasuredCosts(crossing, torch.zeros_like(self.limits), self.measured_limits)
