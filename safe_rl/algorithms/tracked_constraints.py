"""Constraints that go by every step of a batch, and approach their limits before they hold them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from safe_rl.algorithms.constraints import Constraints
from safe_rl.collectors import EpisodeStatistics
from safe_rl.naming import key_name
from safe_rl.objectives.limits import LimitTracker
from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.risk import Charges, RiskMeasure

__all__ = ["CHARGES", "TrackedConstraints"]

CHARGES = "charged_costs"
"""Below ``"next"``, [N, T, k]: what a risk measure has put in the place of the costs."""


class TrackedConstraints(Constraints):
    """`Constraints` whose violations come from a `LimitTracker`.

    ``violation`` is what a step has to promise of J_c to come down by: J_c less its target, over
    the share of promises that come true. Multipliers get J_c less its target, in its units.

    Args:
        limits: Cost key -> d, undiscounted cost allowed per episode.
        tracker: Estimates J_c and what it should be by now.
        multiplier: Weighs the costs against the return, or None.
        risk: What is limited instead of the mean cost of an episode, or None.
        cost_advantage: Key of the cost advantages that the multiplier weighs.
        device: Of all tensors.
    """

    def __init__(
        self,
        limits: Mapping[NestedKey, float],
        *,
        tracker: LimitTracker,
        multiplier: Multiplier | None = None,
        risk: RiskMeasure | None = None,
        cost_advantage: NestedKey = "cost_advantage",
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(limits, multiplier=multiplier, device=device)
        self.tracker, self.risk = tracker, risk
        self.cost_advantage = cost_advantage
        self._charges: Charges | None = None
        self._row: dict[str, float] = {}

    @property
    def schedule(self) -> str:
        """When costs are free, when the limits come down, and when they hold."""
        return self.tracker.schedule if self.keys else ""

    def charge(self, episodes: EpisodeStatistics, batch: TensorDictBase) -> None:
        """Let the risk measure put its charges below ``"next"``, for advantages and violations."""
        if self.risk is None:
            return
        costs = self._costs_of(batch).cpu()
        ends = batch["next", "done"].squeeze(-1).cpu()
        before = torch.stack([episodes.open_costs[key_name(key)] for key in self.keys], -1)
        finished = episodes.episode_costs(self.keys).cpu()
        self._charges = self.risk(costs, ends, before.nan_to_num(0.0).to(costs), finished)
        batch["next", CHARGES] = self._charges.costs.to(batch.device or self.limits.device)

    def _costs_of(self, batch: TensorDictBase) -> Tensor:
        return torch.cat([batch["next", key] for key in self.keys], -1)

    def observe(self, episodes: EpisodeStatistics, batch: TensorDictBase) -> None:
        """Take in a batch [N, T] and move the multiplier.

        Cost advantages that are in the batch for a multiplier to weigh are divided by the size of
        one cost.
        """
        state = self.tracker.update(self._costs_of(batch), episodes.lengths, self._charges)
        state = state.to(self.limits.device)
        self.costs.copy_(state.cost)
        self.violation.copy_(state.demand)
        self.episode_length.copy_(state.length)
        self.unit.copy_(state.unit)
        self._row = self.column("estimate", state.cost) | self.column("target", state.target)
        if self._charges is not None:
            limit = self._charges.limit.to(state.cost)
            self._row |= self.column("violation", state.cost - limit)
        if self.multiplier is None:
            self._row |= self.column("trust", state.trust)
            return
        self.multiplier.set_scale(state.scale)
        self.multiplier.set_unit(state.unit)
        self.multiplier.update(self.limits + state.violation)
        advantage = batch.get(self.cost_advantage, None)
        if advantage is not None:
            batch[self.cost_advantage] = advantage / state.unit

    def expect(self, metrics: Mapping[str, Tensor]) -> None:
        """Note the change of J_c that an update's surrogates promise, if it reports them."""
        if "cost_surrogate" in metrics:
            self.tracker.promises.promise(metrics["cost_surrogate"] * self.episode_length)

    def columns(self) -> dict[str, float]:
        """Estimates, targets, and multipliers or the trust in promises, by column of the table."""
        row = dict(self._row)
        if self.multiplier is not None:
            row |= self.column("multiplier", self.multiplier.value)
        return row

    def state_dict(self) -> dict[str, Any]:
        """State of the tracker, and of the risk measure."""
        states = self.tracker.state_dict()
        return states if self.risk is None else {**states, "risk": self.risk.state_dict()}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.tracker.load_state_dict(state_dict)
        if self.risk is not None:
            self.risk.load_state_dict(state_dict["risk"])
