"""The distance of each cost from its current target, for multipliers and CPO steps.

Four decisions lead from the costs of a batch to the violation that an update sees: how J_c is
estimated (`safe_rl.objectives.episode_costs`), how the limit falls to its final value, how far
below it the target is, and how much of a predicted change of J_c is expected to occur. The reasons
are in `docs/algorithms/holding_the_limit.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import NestedKey
from torch import Tensor

from safe_rl.checks import Checked, Fraction, Share, Weight
from safe_rl.objectives.episode_costs import CostEstimate, EpisodeCosts
from safe_rl.objectives.risk import MeasuredCosts
from safe_rl.resumable import Resumable


@dataclass(frozen=True, kw_only=True)
class LimitState:
    """The state of k limits after a batch: `safe_rl.algorithms.Constraints.update` returns it.

    NaN means that nothing is known yet. Then multipliers stay as they are, and losses and steps
    assume that the policy is exactly at its limits.

    Attributes:
        cost: J_c, undiscounted cost per episode, [k].
        target: Present upper bound of J_c, [k]: d, or another value while the limit falls.
        length: T̄, mean number of time steps of an episode, scalar; None if nobody has said it, as
            multipliers do not need it.
        unit: Typical size of one cost, [k]; see `EpisodeCosts.unit`. Losses weigh costs by
            λ / unit.
        scale: Unit of violations for controllers, [k]: d, or a larger value for limits near 0.
        realised_share: Share of a predicted change of J_c that is observed, [k].
        integral: Weighted sum of the violations so far, with this batch's, which steps add to the
            present one, [k].
        is_new: Whether the batch has changed `cost`. If not, multipliers stay as they are.
        keys: Names of the costs, by which a multiplier finds that its own are in another order.

    Examples:
        >>> state = LimitState.of(cost=[30.0], limit=[25.0], length=1000.0)
        >>> state.violation, state.required_decrease
        (tensor([5.]), tensor([5.]))
    """

    cost: Tensor
    target: Tensor
    length: Tensor | None
    unit: Tensor
    scale: Tensor
    realised_share: Tensor
    integral: Tensor
    is_new: bool = True
    keys: tuple[NestedKey, ...] = ()

    @classmethod
    def of(
        cls,
        *,
        cost: Tensor | Sequence[float],
        limit: Tensor | Sequence[float],
        length: Tensor | float | None = None,
        is_new: bool = True,
    ) -> LimitState:
        """The state without a tracker: the target is the limit d, and costs have the unit 1.

        Raises:
            ValueError: If there are not as many costs as limits.
        """
        limit = torch.as_tensor(limit, dtype=torch.float32)
        cost = torch.as_tensor(cost).to(limit)
        if cost.shape != limit.shape:
            raise ValueError(f"{cost.numel()} costs and {limit.numel()} limits: give one of each.")
        return cls(
            cost=cost,
            target=limit,
            length=None if length is None else torch.as_tensor(length).to(limit),
            unit=torch.ones_like(limit),
            scale=torch.where(limit > 0, limit, 1.0),
            realised_share=torch.ones_like(limit),
            integral=torch.zeros_like(limit),
            is_new=is_new,
        )

    @property
    def violation(self) -> Tensor:
        """J_c − target, [k]."""
        return self.cost - self.target

    @property
    def required_decrease(self) -> Tensor:
        """Decrease of J_c that a step's surrogate must predict, [k]; if negative, J_c may rise.

        Violation plus integral. If only a share of predicted decreases is observed, the prediction
        has to be larger accordingly.
        """
        change = self.violation + self.integral
        return torch.where(change > 0, change / self.realised_share, change)

    def required_decrease_for(self, surrogates: Tensor) -> Tensor:
        """`required_decrease` with the dtype and device of cost surrogates [k], and 0 for NaN."""
        decrease = self.required_decrease
        if decrease.shape != surrogates.shape:
            raise ValueError(
                f"There are {surrogates.numel()} cost surrogate(s) and {decrease.numel()} limits: "
                "cost_advantage needs one column per limit."
            )
        return decrease.to(surrogates).nan_to_num(nan=0.0)

    def excess(self, surrogates: Tensor) -> Tensor:
        """Predicted amount above the target, per time step, [k], from cost surrogates [k].

        A surrogate is an average per time step, so the required decrease of an episode's cost is
        divided by the episode's length.
        """
        decrease = self.required_decrease_for(surrogates)
        return surrogates + decrease / self.length_for(surrogates)

    def length_for(self, surrogates: Tensor) -> Tensor:
        """T̄ with the dtype and device of surrogates."""
        if self.length is None:
            raise ValueError(
                "The state of the limits has no episode length, by which violations are divided: "
                "LimitState.of(cost=…, limit=…, length=…)."
            )
        return self.length.to(surrogates)

    def check(self, costs: Sequence[NestedKey]) -> None:
        """Raise a ValueError if this is not the state of one limit per cost, in their order."""
        if self.violation.shape != (len(costs),):
            shape = tuple(self.violation.shape)
            raise ValueError(f"One limit for each of {[*costs]}, got a state of the shape {shape}.")
        check_order(self.keys, costs)

    def to(self, like: Tensor) -> LimitState:
        """The same with the dtype and device of a tensor."""
        tensors: Any = {k: v.to(like) for k, v in vars(self).items() if isinstance(v, Tensor)}
        return replace(self, **tensors)


def check_order(costs: Sequence[NestedKey], others: Sequence[NestedKey]) -> None:
    """Refuse costs that are the others in another order: each would get the λ of another one."""
    if [*costs] != [*others] and sorted(map(str, costs)) == sorted(map(str, others)):
        raise ValueError(
            f"The costs {[*costs]} are in another order than those with limits, {[*others]}: name "
            "both in one order."
        )


class PredictedChange(Resumable):
    """Share of predicted changes of J_c that was observed, by a regression through the origin.

    The observed change of one update is mostly noise, but Σ predicted · observed / Σ predicted²
    over many updates is not. The share begins as 1, with the weight of one prediction of size
    `prior`. `decay` is the weight of the past in these sums, in [0, 1), `lowest` the lower bound of
    the share; with 1, predictions are not corrected.
    """

    state_names = ("_predicted", "_cost", "_products")

    def __init__(self, num_costs: int, *, decay: float, lowest: float) -> None:
        self.decay, self.lowest = decay, lowest
        self._predicted, self._cost = torch.full((2, num_costs), torch.nan, dtype=torch.float32)
        self._products = torch.zeros(2, num_costs, dtype=torch.float32)

    @property
    def share(self) -> Tensor:
        """The share, [k], in [lowest, 1]."""
        realised, predicted = self._products
        share = torch.where(predicted > 0, realised / predicted, 1.0)
        return share.clamp(self.lowest, 1.0)

    def update(self, cost: Tensor, prior: Tensor) -> None:
        """Compare the change of J_c since the last call with the predicted change; all [k]."""
        if not self._products.any():
            self._products = prior.square().expand(2, -1).clone()
        predicted = self._predicted
        products = predicted * torch.stack([cost - self._cost, predicted])
        known = products.isfinite().all(0)
        updated = self.decay * self._products + products
        self._products = torch.where(known, updated, self._products)
        self._cost = cost.clone()
        self._predicted = torch.full_like(predicted, torch.nan)

    def record_prediction(self, change: Tensor) -> None:
        """Store the change of J_c that an update's surrogate predicts, [k]."""
        self._predicted = change.detach().to(self._predicted)


class LimitTracker(Checked, Resumable):
    """Computes violations of a falling limit from the costs of every batch.

    Args:
        cost_limits: Limits d, undiscounted cost per episode, [k].
        max_length: Largest length of an episode, in time steps of a batch.
        margin: Distance of the target below the limit, in standard errors of a batch's J_c.
        largest_margin: Upper bound of the margin, as a share of d.
        free_steps: Environment steps at the start in which the limit is a scale above the cost.
        descent_steps: Environment steps, after free_steps, during which the limit falls to d.
        steps_per_decision: Environment steps per time step of a batch, which is one action.
        frames: Environment steps of the whole run.
        latest_end: Share of the run at which the descent ends at the latest. In a shorter run,
            free_steps and descent_steps are reduced in proportion.
        smallest_scale: Lower bound of the unit of violations, for limits near 0: number of costs of
            size `LimitState.unit` per time step of a batch.
        drift: Expected relative change of J_c per update, see `EpisodeCosts`; None uses each batch
            alone.
        decay: Weight of the past in the averages of a batch's standard error and of trust_<cost>.
        lowest_realised_share: Lower bound of the share of a predicted change of J_c that is
            expected to occur (column trust_<cost>); 1 expects all of it.
        integral: Share of every violation that is added to it and to those of all later updates
            (the learned margin of the code of Ray, Achiam and Amodei 2019); 0 for multipliers,
            which have integrals of their own.
        largest_integral: Upper bound of the sum that integral adds, as a share of the limit.

    Examples:
        >>> tracker = LimitTracker(
        ...     torch.tensor([25.0]), max_length=1000, margin=0.0, largest_margin=0.2,
        ...     free_steps=0, descent_steps=800, frames=10_000, latest_end=0.7,
        ...     smallest_scale=0.01, drift=0.2, decay=0.9, lowest_realised_share=1.0, integral=0.0,
        ...     largest_integral=0.5,
        ... )
        >>> costs = torch.full((4, 100, 1), 0.065)
        >>> state = tracker.update(costs, lengths=torch.empty(0))
        >>> state.cost, state.target  # half of the descent is over
        (tensor([65.]), tensor([45.]))
    """

    state_names = ("costs", "predictions", "_steps", "_reached", "_noise", "_integral")

    def __init__(
        self,
        cost_limits: Tensor,
        *,
        max_length: float,
        margin: NonNegativeFloat,
        largest_margin: Share,
        free_steps: NonNegativeInt,
        descent_steps: NonNegativeInt,
        frames: PositiveInt,
        latest_end: Fraction,
        smallest_scale: PositiveFloat,
        drift: PositiveFloat | None,
        decay: Weight,
        lowest_realised_share: Fraction,
        integral: NonNegativeFloat,
        largest_integral: NonNegativeFloat,
        steps_per_decision: int = 1,
    ) -> None:
        self.limits = cost_limits.detach().cpu().float()
        num_costs = len(self.limits)
        self.margin, self.largest_margin = margin, largest_margin
        shrinkage = min(1.0, latest_end * frames / max(free_steps + descent_steps, 1))
        self.free_steps = round(free_steps * shrinkage)
        self.descent_steps = round(descent_steps * shrinkage)
        self._is_shortened = shrinkage < 1
        self.decay, self.steps_per_decision = decay, steps_per_decision
        self.costs = EpisodeCosts(
            num_costs, max_length=max_length, drift=drift, decay=decay, smallest=smallest_scale
        )
        self.predictions = PredictedChange(num_costs, decay=decay, lowest=lowest_realised_share)
        self.integral, self.largest_integral = integral, largest_integral
        self._steps = 0
        self._integral = torch.zeros_like(self.limits)
        self._reached = torch.full_like(self.limits, torch.inf)
        self._noise = torch.full_like(self.limits, torch.nan)

    @property
    def schedule(self) -> str:
        """A sentence: until when limits are above the costs, when they fall, and when they hold."""
        end = self.free_steps + self.descent_steps
        if not end:
            return ""
        line = f"fall until step {end:,} and are constant from there."
        if self.free_steps:
            line = f"are above the present costs until step {self.free_steps:,}, {line}"
        line = f"The limits {line}"
        if self._is_shortened:
            line += " (limits.free_steps and limits.descent_steps are shortened to fit frames=…)"
        return line

    @torch.no_grad()
    def update(
        self, costs: Tensor, lengths: Tensor, measured: MeasuredCosts | None = None
    ) -> LimitState:
        """Update estimates and targets with a batch; arguments as of `EpisodeCosts.update`."""
        costs, lengths = costs.detach().cpu(), lengths.detach().cpu()
        estimate = self.costs.update(costs, lengths, measured)
        if measured is not None:
            self.limits = measured.limit
        batch = self.costs.batch
        scale = self.costs.scale(self.limits)
        self.predictions.update(batch.mean, prior=0.5 * scale)
        noise = torch.lerp(batch.error, self._noise, self.decay)
        self._noise = torch.where(noise.isfinite(), noise, batch.error)
        num_steps = costs.shape[0] * costs.shape[1] * self.steps_per_decision
        target = self._target(estimate, scale, num_steps)
        error = (estimate.mean - target).clamp(-scale, scale)
        integral = (self._integral + self.integral * error).clamp_min(0)
        self._integral = torch.minimum(integral, self.largest_integral * scale)
        return LimitState(
            cost=estimate.mean,
            target=target,
            length=self.costs.lengths.mean,
            unit=self.costs.unit,
            scale=scale,
            realised_share=self.predictions.share,
            integral=self._integral,
        )

    def _target(self, estimate: CostEstimate, scale: Tensor, num_steps: int) -> Tensor:
        """The target of J_c after an update with a batch of `num_steps` steps, [k]."""
        self._steps += num_steps
        # a descent that has begun continues, even if a resumed run has more steps than before
        if self._steps <= self.free_steps and not self._reached.isfinite().any():
            return estimate.mean + scale
        margin = torch.minimum(self.margin * self._noise, self.largest_margin * self.limits)
        left = self.free_steps + self.descent_steps - self._steps + num_steps
        # of what is left: so the descent ends after its steps, whatever the size of a batch
        share = num_steps / left if left > num_steps else 1.0
        # if the cost is already below the falling limit, the limit continues from the cost
        reached, goal = torch.minimum(self._reached, estimate.mean), self.limits - margin
        self._reached = goal + (reached - goal).clamp_min(0) * (1 - share)
        return self._reached
