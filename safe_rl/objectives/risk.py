"""Limits on more than the mean: the worst episodes (CVaR), and how many may cost too much.

A limit d on the mean cost leaves a third to a half of the episodes above d. A risk measure replaces
the costs of steps by *charges*, whose sum over an episode has the measure as its mean, up to an
offset that does not depend on the policy to first order. Everything that holds a limit on a mean
(critics, advantages, multipliers, steps, the descent of the limit) then holds one on the measure.

Charges fall due when the cost of the episode so far passes a threshold, so that they need to know
what it had cost when the batch began, and batches need not hold whole episodes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from safe_rl.ranges import Checked, Fraction, Range, Weight
from safe_rl.resumable import Resumable


class Charges(NamedTuple):
    """What stands for the costs of a batch.

    Attributes:
        costs: Charges of its steps, [N, T, k].
        offset: What is to be added to the charges of an episode, [k].
        limit: What the sum is held against, [k].
    """

    costs: Tensor
    offset: Tensor
    limit: Tensor


class RiskMeasure(Checked, Resumable, ABC):
    """A measure of episode costs that is limited instead of their mean.

    One that depends on more than the batch names this in ``state_names``.

    Attributes:
        limits: d, [k].
    """

    limits: Tensor

    @property
    def held_limits(self) -> Tensor:
        """What an episode's charges are held against on average, [k]."""
        return self.limits

    @abstractmethod
    def __call__(self, costs: Tensor, ends: Tensor, before: Tensor, finished: Tensor) -> Charges:
        """Charge the steps of a batch.

        Args:
            costs: Costs of its steps, [N, T, k], none negative.
            ends: Whether an episode ends with a step, [N, T] bool.
            before: Cost of the open episodes before the first step, [N, k].
            finished: Costs of the episodes that finished, [E, k].
        """


def value_at_risk(costs: Tensor, tail: float) -> Tensor:
    """The cost that at most a fraction `tail` of the episodes exceeds: [E, k] -> [k].

    Examples:
        >>> value_at_risk(torch.tensor([[1.0], [2.0], [3.0], [4.0]]), tail=0.25)
        tensor([3.])
    """
    ranked = costs.sort(0, descending=True).values
    return ranked[min(int(tail * len(ranked)), len(ranked) - 1)]


def cost_so_far(costs: Tensor, ends: Tensor, before: Tensor) -> Tensor:
    """Cost of the episode up to and with each step, [N, T, k]; arguments as of `RiskMeasure`.

    Examples:
        >>> costs, ends = torch.ones(1, 4, 1), torch.tensor([[False, True, False, False]])
        >>> cost_so_far(costs, ends, before=torch.tensor([[10.0]])).flatten()
        tensor([11., 12.,  1.,  2.])
    """
    # in double precision, so that an episode without costs has cost exactly nothing
    total = costs.double().cumsum(1) + before.unsqueeze(1)
    closed = torch.where(ends.unsqueeze(-1), total, 0).roll(1, 1)
    closed[:, 0] = 0
    return (total - closed.cummax(1).values).to(costs)


class CVaR(RiskMeasure):
    """CVaR_α ≤ d: the mean cost of the worst fraction α of the episodes.

    CVaR = ν + E[(C − ν)₊] / α with ν, the value at risk, the cost that a fraction α of the episodes
    exceeds (Rockafellar and Uryasev 2000, theorem 1). ν minimises the expression, so that how it
    moves with the policy is of second order, and (C − ν)₊ / α has the gradient (Chow, Ghavamzadeh,
    Janson and Pavone 2017). A step is charged for what it adds to (C − ν)₊ / α.

    Before the tail is ramped in, the mean is limited: with κ from 0 to 1, what is limited is
    (1 − κ) E[C] + κ CVaR. A CVaR limit needs a d of its own: that of a policy with a mean of 25 is
    about 60 at α = 0.1 on PointGoal1.

    Args:
        cost_limits: d, [k].
        tail: Share α of the worst episodes.
        window: Episodes of the past from which ν, the value at risk, is taken.
        ramp_start: Environment steps before which κ = 0: the mean is limited.
        ramp_steps: Environment steps in which κ then goes to 1.
        steps_per_decision: Environment steps per row of time of a batch.

    Examples:
        >>> risk = CVaR(torch.tensor([50.0]), tail=0.5, window=100, ramp_start=0, ramp_steps=0)
        >>> costs, ends = torch.ones(2, 3, 1), torch.tensor([[False, False, True]] * 2)
        >>> finished = torch.tensor([[3.0], [13.0]])
        >>> charges = risk(costs, ends, torch.tensor([[0.0], [10.0]]), finished)
        >>> charges.costs.sum((1, 2)), charges.offset  # ν = 3
        (tensor([0., 6.]), tensor([3.]))
    """

    state_names = ("_finished", "_steps")

    def __init__(
        self,
        cost_limits: Tensor,
        *,
        tail: Fraction,
        window: Annotated[int, Range(1, 10**6)],
        ramp_start: Annotated[int, Range(0)],
        ramp_steps: Annotated[int, Range(0)],
        steps_per_decision: int = 1,
    ) -> None:
        self.limits = cost_limits.detach().cpu().float()
        self.tail, self.window = tail, window
        self.ramp_start, self.ramp_steps = ramp_start, ramp_steps
        self._steps_per_decision = steps_per_decision
        self._steps = 0
        self._finished = torch.empty(0, len(self.limits))

    @property
    def weight(self) -> float:
        """κ of the tail in [0, 1]; the mean has the rest."""
        if not len(self._finished):
            return 0.0
        return min(1.0, max(0.0, (self._steps - self.ramp_start) / max(1, self.ramp_steps)))

    def __call__(self, costs: Tensor, ends: Tensor, before: Tensor, finished: Tensor) -> Charges:
        """Charge the steps of a batch: see `RiskMeasure`."""
        self._finished = torch.cat([self._finished, finished.float()])[-self.window :]
        self._steps += ends.numel() * self._steps_per_decision
        weight = self.weight
        if not weight:
            return Charges(costs, torch.zeros_like(self.limits), self.limits)
        threshold = value_at_risk(self._finished, self.tail)
        beyond = (cost_so_far(costs, ends, before) - threshold).clamp_min(0)
        tail = torch.minimum(costs, beyond) / self.tail
        return Charges((1 - weight) * costs + weight * tail, weight * threshold, self.limits)


class Chance(RiskMeasure):
    """P(C > d) ≤ ε: at most a fraction ε of the episodes costs more than d.

    The step with which an episode's cost passes d is charged w = max(d, 1) and no other, so that an
    episode's charges are w 1{C > d}; their mean is held against w ε. The weight gives λ the size
    that it has for limits on means.

    Args:
        cost_limits: d, [k].
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
    def held_limits(self) -> Tensor:
        """What an episode's charges are held against on average, w ε, [k]."""
        return self.weight * self.most_over

    def __call__(self, costs: Tensor, ends: Tensor, before: Tensor, finished: Tensor) -> Charges:
        """Charge the steps of a batch: see `RiskMeasure`."""
        over = cost_so_far(costs, ends, before) > self.limits
        was_over = (over & ~ends.unsqueeze(-1)).roll(1, 1)
        was_over[:, 0] = before > self.limits
        charged = torch.where(over & ~was_over, self.weight, 0.0).to(costs)
        return Charges(charged, torch.zeros_like(self.limits), self.held_limits)
