"""The constraints of a run: costs, limits, and the distance of the policy from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from safe_rl.collectors import EpisodeStatistics
from safe_rl.naming import did_you_mean, key_name
from safe_rl.objectives.limits import LimitTracker
from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.risk import Charges, RiskMeasure
from safe_rl.ranges import is_number
from safe_rl.resumable import Resumable


class Constraints(Resumable):
    """Constraints of an algorithm: cost keys, limits d, violations J_c − d, and the multiplier.

    Every algorithm has one such object, and updates it with every batch. Losses and updates that
    need violations get this object, and read ``violation`` and ``episode_length`` at every call.

    Args:
        limits: Cost key -> d, undiscounted cost allowed per episode; empty without constraints.
        max_length: Largest length of an episode in steps. It is the mean length until an episode
            has finished. None takes the length of the batch.
        multiplier: Multiplier that weighs the costs against the return, or None.
        device: Device of all tensors.

    Attributes:
        keys: Keys of the k costs.
        limits: Limits d, [k].
        costs: J_c, undiscounted cost per episode, [k], as of the last batch.
        violation: J_c − d, [k], as of the last batch.
        episode_length: T̄, mean number of decisions (time steps of a batch) per episode, scalar.
        unit: Typical size of one cost, by which losses divide λ, [k]; see `EpisodeCosts.unit`.
        risk: Risk measure that is limited instead of the mean cost of an episode, or None.
        cost_advantage: Key of the cost advantages that the multiplier weighs.
        schedule: A sentence on when the limits begin to hold; empty if they do from the start.

    Examples:
        >>> from tensordict import TensorDict
        >>> constraints = Constraints({"cost": 25.0})
        >>> episodes = EpisodeStatistics(
        ...     returns=torch.ones(2),
        ...     costs={"cost": torch.tensor([20.0, 40.0])},
        ...     lengths=torch.tensor([1000.0, 1000.0]),
        ...     cost_rates={"cost": torch.tensor(0.03)},
        ... )
        >>> constraints.update(episodes, TensorDict(batch_size=[2, 1000]))
        >>> constraints.violation, constraints.episode_length
        (tensor([5.]), tensor(1000.))
    """

    schedule = ""
    # mean costs and length of episodes in the last batch in which an episode finished
    state_names = ("_finished", "_mean_length")

    def __init__(
        self,
        limits: Mapping[NestedKey, float],
        *,
        max_length: int | None = None,
        multiplier: Multiplier | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        self.keys = list(limits)
        self.limits = torch.tensor(list(limits.values()), dtype=torch.float32, device=device)
        self.multiplier = multiplier
        self.risk: RiskMeasure | None = None
        self.cost_advantage: NestedKey = "cost_advantage"
        self._max_length = max_length
        self.costs = torch.full_like(self.limits, torch.nan)
        self.violation = torch.full_like(self.limits, torch.nan)
        self.episode_length = torch.full((), torch.nan, device=device)
        self.unit = torch.ones_like(self.limits)
        self._finished = torch.full_like(self.limits, torch.nan)
        self._mean_length = torch.full((), torch.nan, device=device)
        self._row: dict[str, float] = {}

    @property
    def held_limits(self) -> dict[NestedKey, float]:
        """Limits from which violations are measured, by cost: d, or those of the risk measure."""
        held = self.limits if self.risk is None else self.risk.held_limits
        return dict(zip(self.keys, held.tolist(), strict=True))

    def apply_risk(self, episodes: EpisodeStatistics, batch: TensorDictBase) -> None:
        """Write the costs of a risk measure into a batch, before advantages are estimated."""

    def update(self, episodes: EpisodeStatistics, batch: TensorDictBase) -> None:
        """Update costs, violations and the multiplier from the episodes of a batch.

        The episode length is the mean over the last batch in which an episode finished. J_c is that
        batch's mean too, if batches are at least as long as episodes. In shorter batches J_c is the
        cost rate times the episode length.

        Args:
            episodes: Statistics of the batch.
            batch: The batch itself, [N, T].
        """
        if episodes.num_episodes:
            self._finished = episodes.mean_costs(self.keys).to(self._finished)
            self._mean_length = episodes.decisions.mean().to(self._mean_length)
        costs, length = self._finished, self._mean_length
        has_finished = bool(length.isfinite())
        if not has_finished:
            length = torch.full_like(length, float(self._max_length or batch.shape[-1]))
        goes_by_rate = batch.shape[-1] < float(length)
        if self.keys and (goes_by_rate or not has_finished):
            rates = [batch["next", key].to(costs).mean() for key in self.keys]
            costs = torch.stack(rates) * length
        # in place: compiled losses read the same tensors every time
        self.costs.copy_(costs)
        self.violation.copy_(costs - self.limits)
        self.episode_length.copy_(length)
        self._row = self.column("violation", self.violation)
        if self.multiplier is not None and (goes_by_rate or episodes.num_episodes):
            self.multiplier.update(costs - self.limits)

    def record_prediction(self, metrics: Mapping[str, Tensor]) -> None:
        """Store the change of J_c that an update predicts."""

    def columns(self) -> dict[str, float]:
        """Values of the last batch and multipliers, by name of their column in the run's table."""
        row = dict(self._row)
        if self.multiplier is not None:
            row |= self.column("multiplier", self.multiplier.value)
        return row

    def column(self, name: str, value: Tensor) -> dict[str, float]:
        """Columns of the run's table: one for a scalar, one per constraint for a vector [k].

        A vector [1] counts as a scalar, unless there is exactly one constraint.

        Raises:
            ValueError: For any other shape.

        Examples:
            >>> Constraints({("agents", "cost"): 25.0}).column("violation", torch.tensor([5.0]))
            {'violation_agents/cost': 5.0}
        """
        if value.numel() == 1 and (value.ndim == 0 or len(self.keys) != 1):
            return {name: value.item()}
        if value.shape != (len(self.keys),):
            raise ValueError(
                f"'{name}' has the shape {list(value.shape)}: what is logged is one number, or one "
                f"for each of {len(self.keys)} constraints."
            )
        names = map(key_name, self.keys)
        return {f"{name}_{key}": v for key, v in zip(names, value.tolist(), strict=True)}


def check_cost_limits(
    cost_limits: Mapping[str, float], cost_keys: Sequence[str]
) -> dict[str, float]:
    """Check that the environment has every key, and return the limits as a plain dictionary.

    Raises:
        ValueError: If a key is unknown, or a limit is negative, infinite or not a number.
    """
    limits: dict[str, float] = {}
    for key, limit in cost_limits.items():
        if key not in cost_keys:
            raise ValueError(
                f"cost_limits names '{key}', but this environment has no such cost."
                f"{did_you_mean(key, cost_keys, 0.7)} It has {', '.join(cost_keys)}; in Safety "
                "Gym's environments env.constrain_<kind>=true adds those of another kind."
            )
        if not is_number(limit) or limit < 0:
            raise ValueError(
                f"The limit of '{key}' is {limit!r}: it must be a number of at least 0, the "
                "undiscounted cost allowed per episode. Leave out a cost that has no limit."
            )
        limits[key] = float(limit)
    return limits


CHARGES = "charged_costs"
"""Key below ``"next"``, [N, T, k], of the charges that a risk measure puts in place of costs."""


class TrackedConstraints(Constraints):
    """`Constraints` whose violations come from a `LimitTracker`.

    ``violation`` is `LimitState.demand`, the decrease of J_c that a step's surrogate must predict:
    J_c minus its target, plus an integral of earlier violations, divided by the share of predicted
    changes that is observed. Multipliers get J_c minus its target.

    Args:
        limits: Cost key -> d, undiscounted cost allowed per episode.
        tracker: Tracker that estimates J_c and computes its current target.
        multiplier: Multiplier that weighs the costs against the return, or None.
        risk: Risk measure that is limited instead of the mean cost of an episode, or None.
        device: Device of all tensors.
    """

    state_names = ("tracker", "risk")

    def __init__(
        self,
        limits: Mapping[NestedKey, float],
        *,
        tracker: LimitTracker,
        multiplier: Multiplier | None = None,
        risk: RiskMeasure | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(limits, multiplier=multiplier, device=device)
        self.tracker, self.risk = tracker, risk
        self.schedule = tracker.schedule if self.keys else ""
        self._charges: Charges | None = None

    def apply_risk(self, episodes: EpisodeStatistics, batch: TensorDictBase) -> None:
        """Write the costs of the risk measure below ``"next"``."""
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

    def update(self, episodes: EpisodeStatistics, batch: TensorDictBase) -> None:
        """Update the tracker and the multiplier from a batch [N, T].

        With a multiplier, cost advantages in the batch are divided by the typical size of one cost.
        """
        state = self.tracker.update(self._costs_of(batch), episodes.decisions, self._charges)
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
        self.multiplier.set_target(state.target)
        self.multiplier.update(state.violation)
        advantage = batch.get(self.cost_advantage, None)
        if advantage is not None:
            batch[self.cost_advantage] = advantage / state.unit

    def record_prediction(self, metrics: Mapping[str, Tensor]) -> None:
        """Store the change of J_c that an update's surrogates predict, if it reports them."""
        if "cost_surrogate" in metrics:
            change = metrics["cost_surrogate"] * self.episode_length
            self.tracker.predictions.record_prediction(change)
