"""Estimates of J_c, the cost of an episode, also from batches that are shorter than episodes.

The estimate is the cost rate of a batch times the mean length of an episode, J_c = (Σ c / steps) ·
T̄. It uses every step. By the renewal-reward theorem it converges to E[C], even if the length and
the cost of an episode depend on each other. There are two conditions: rows must be at independent
points of their episodes (``staggered_starts``), and the policy must not change. If all rows are in
the same part of an episode, the rate is that of this part. For a batch of many whole episodes the
estimate *is* their mean cost.

T̄ is the number of steps in the last batches, divided by the number of episodes that ended in them.
While episodes grow longer, the mean length of the ended episodes would be too low, by a factor of
two to five. Most long episodes have not ended yet, and many of the ended ones are short.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from safe_rl.objectives.risk import MeasuredCosts
from safe_rl.resumable import Resumable

#: Number of ends of episodes over which the mean length is computed.
_ENDS = 100
#: Smallest number of pieces for a standard error; a batch with fewer rows is cut into as many.
_FEWEST_PIECES = 8


class CostEstimate(NamedTuple):
    """An estimate of J_c, the undiscounted cost per episode."""

    mean: Tensor  # [k]
    error: Tensor  # its standard error, [k]


def rate_estimate(costs: Tensor, length: Tensor) -> CostEstimate:
    """J_c as cost per step times steps per episode, with the standard error over rows.

    Costs are [N, T, k]: N rows of T consecutive steps. If there are few rows, they are cut into
    pieces that are taken as independent.
    """
    rows, steps, num_costs = costs.shape
    cuts = min(steps, -(-_FEWEST_PIECES // rows))
    pieces = costs[:, : steps // cuts * cuts].reshape(rows * cuts, -1, num_costs)
    rates = pieces.mean(1)
    error = rates.std(0) / rates.shape[0] ** 0.5 if rates.shape[0] > 1 else rates.new_zeros(())
    return CostEstimate(costs.mean((0, 1)) * length, (error * length).expand(num_costs))


def shrink(past: CostEstimate, present: CostEstimate, drift: Tensor) -> CostEstimate:
    """Average two estimates by their precision: one step of a Kalman filter on a random walk.

    `past` is the estimate for the policies so far, NaN if there is none, and `present` that of this
    batch alone. `drift` is the standard deviation of the change of J_c from one policy to the next,
    [k]. The result has an error of at most `present.error`.
    """
    variance = past.error.square() + drift.square()
    noise = present.error.square()
    # if both errors and the drift are 0, the new estimate is exact
    weight = torch.where(variance + noise > 0, variance / (variance + noise), 1.0)
    mean = torch.lerp(past.mean, present.mean, weight)
    error = ((1 - weight) * variance).sqrt()
    known = past.mean.isfinite()
    return CostEstimate(
        torch.where(known, mean, present.mean), torch.where(known, error, present.error)
    )


class EpisodeLengths(Resumable):
    """Mean episode length T̄: steps per ended episode, over the last 100 ends or a few more.

    The counted steps begin after a batch in which episodes ended. Later batches without such ends
    count too, and make T̄ larger. T̄ is at most the largest possible length, and equal to it until
    an episode has ended before this length.

    Args:
        longest: Largest possible length of an episode in steps.
    """

    state_names = ("counts",)

    def __init__(self, longest: float) -> None:
        self.longest = longest
        #: Steps, ends and early ends since the previous row, a row per batch with ends, [n, 3].
        self.counts = torch.zeros(0, 3, dtype=torch.float64)

    def update(self, num_steps: int, lengths: Tensor) -> None:
        """Add the number of steps of a batch, and the lengths [E] of episodes that ended in it."""
        early = int((lengths < self.longest).sum())
        row = torch.tensor([[num_steps, lengths.numel(), early]], dtype=torch.float64)
        if len(self.counts) and not self.counts[-1, 1]:
            row += self.counts[-1:]
            self.counts = self.counts[:-1]
        self.counts = torch.cat([self.counts, row])
        ends_since = self.counts[:, 1].flip(0).cumsum(0).flip(0)
        first = int((ends_since >= _ENDS).sum()) - 1
        self.counts = self.counts[max(first, 0) :]

    @property
    def mean(self) -> Tensor:
        """T̄ in steps, scalar."""
        steps, ends, early = self.counts.sum(0).tolist()
        mean = min(steps / ends, self.longest) if early else float(self.longest)
        return torch.tensor(mean, dtype=torch.float32)


class EpisodeCosts(Resumable):
    """Estimator of J_c, of the mean episode length T̄ and of the size of one cost, over a run.

    Args:
        num_costs: Number of costs k.
        max_length: Largest length of an episode in steps; see `EpisodeLengths`.
        drift: Expected relative change of J_c from one policy to the next; it sets the weights of
            past batches and of the new one. None uses the new batch alone.
        decay: Weight in [0, 1) of the past in the estimated variance of costs.
        smallest: Costs per step, of size `unit`. The drift is relative to J_c, or to the J_c of
            this many costs if it is larger. Otherwise an estimate of 0 could never change again.

    Attributes:
        lengths: Mean episode length T̄.
    """

    state_names = ("_mean", "_error", "_sums", "_scatter", "lengths")

    def __init__(
        self,
        num_costs: int,
        *,
        max_length: float,
        drift: float | None,
        decay: float,
        smallest: float = 0.0,
    ) -> None:
        self.drift, self.decay, self.smallest = drift, decay, smallest
        self.lengths = EpisodeLengths(max_length)
        self._mean, self._error = torch.full((2, num_costs), torch.nan, dtype=torch.float32)
        #: The estimate from the last batch alone.
        self.batch = self.estimate
        self._sums = torch.zeros(2, num_costs, dtype=torch.float64)
        self._scatter = torch.zeros(2, num_costs, dtype=torch.float32)

    @property
    def unit(self) -> Tensor:
        """Typical size of one cost, Σ c² / Σ c over all steps, [k]; 1 for costs of 0 or 1."""
        first, second = self._sums
        return torch.where(first > 0, second / first, 1.0).float()

    @property
    def estimate(self) -> CostEstimate:
        """The last estimate; NaN before the first batch."""
        return CostEstimate(self._mean, self._error)

    def update(
        self, costs: Tensor, lengths: Tensor, measured: MeasuredCosts | None = None
    ) -> CostEstimate:
        """Update the estimate with a batch.

        Args:
            costs: Costs of its steps, [N, T, k].
            lengths: Steps of every episode that finished in it, [E].
            measured: Costs of a risk measure, which are estimated instead; `unit` ignores them.
        """
        costs = costs.to(self._sums)
        self._sums += torch.stack([costs.sum((0, 1)), costs.square().sum((0, 1))])
        self.lengths.update(costs.shape[0] * costs.shape[1], lengths)
        limited = costs if measured is None else measured.costs.to(costs)
        batch = CostEstimate(*(each.float() for each in rate_estimate(limited, self.lengths.mean)))
        if measured is not None:
            batch = batch._replace(mean=batch.mean + measured.offset)
        self.batch = batch
        if self.drift is not None:
            size = self.scale(self.estimate.mean)
            expected = batch._replace(error=self._expected_error(batch, size))
            batch = shrink(self.estimate, expected, self.drift * size)
        self._mean, self._error = batch
        return batch

    def scale(self, mean: Tensor) -> Tensor:
        """A J_c, or that of `smallest` costs per step if it is larger, [k]."""
        return torch.maximum(mean, self.smallest * self.lengths.mean * self.unit)

    def _expected_error(self, batch: CostEstimate, size: Tensor) -> Tensor:
        """Standard error of a batch, expected from earlier batches, for J_c of this size, [k].

        Costs come in clusters. A batch that has few costs by chance also has a small standard
        error. With this error as its weight, it would count more than a batch with many costs, and
        the estimate would be too low. So the variance is assumed to be proportional to J_c, as for
        counts. The factor of proportionality is estimated.
        """
        seen = torch.stack([batch.error.square(), self.scale(batch.mean)])
        self._scatter = torch.lerp(seen, self._scatter, self.decay)
        squared, sizes = self._scatter
        error = (squared / sizes * size).sqrt()
        return torch.where(error.isfinite(), error, batch.error)
