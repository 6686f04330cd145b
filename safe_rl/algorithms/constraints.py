"""The constraints of a run: costs, limits, and how far the policy is from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Self

import torch
from omegaconf import DictConfig
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

from safe_rl.checks import parameters_of
from safe_rl.collectors import EpisodeStatistics
from safe_rl.naming import did_you_mean, key_name
from safe_rl.objectives.limits import LimitState, LimitTracker
from safe_rl.objectives.multipliers import Multiplier, parse_cost_limits
from safe_rl.objectives.risk import MeasuredCosts, RiskMeasure
from safe_rl.resumable import Resumable
from safe_rl.trust import instantiate, locate


class Constraints(Resumable):
    """Costs with limits d on J_c, the mean undiscounted cost of an episode.

    Call `update` with every batch. It returns a `LimitState`, which multipliers, losses and steps
    take. Without a tracker, J_c is the mean of the episodes that finished in the batch, or, in
    batches shorter than an episode, the cost per step times the length; its target is d.

    Args:
        limits: Cost key -> d, undiscounted cost allowed per episode; empty without constraints.
        max_length: Largest length of an episode in time steps of a batch. Without a tracker, it is
            the mean length until an episode has finished; with None nothing is known until then
            (NaN).
        tracker: Tracker that estimates J_c and computes its current target, or None.
        risk: Risk measure that is limited instead of the mean cost of an episode, or None. It needs
            a tracker.
        device: Device of the state.
        done_key: Key below ``next`` of the ends of episodes, which a risk measure needs.

    Attributes:
        keys: Keys of the k costs.
        cost_limits: Cost key -> d.
        limits: Limits d, [k].
        schedule: A sentence on when the limits begin to hold; empty if they do from the start.

    Examples:
        >>> from tensordict import TensorDict
        >>> from safe_rl.collectors import EpisodeAccounting
        >>> constraints = Constraints({"cost": 1.0})
        >>> done = torch.tensor([[[False], [True]]])
        >>> steps = {"reward": torch.ones(1, 2, 1), "cost": torch.ones(1, 2, 1), "done": done}
        >>> batch = TensorDict({"next": steps}, [1, 2])
        >>> episodes = EpisodeAccounting(num_envs=1, cost_keys=["cost"]).update(batch)
        >>> state = constraints.update(batch, episodes)
        >>> state.cost, state.violation, state.length
        (tensor([2.]), tensor([1.]), tensor(2.))
    """

    def __init__(
        self,
        limits: Mapping[NestedKey, float],
        *,
        max_length: int | None = None,
        tracker: LimitTracker | None = None,
        risk: RiskMeasure | None = None,
        device: torch.device | str | None = None,
        done_key: NestedKey = "done",
    ) -> None:
        if risk is not None and tracker is None:
            raise ValueError(
                "risk: only the mean cost is limited by the episodes of a batch alone "
                "(limits=null); other measures need limits, as in conf/algo/cpo.yaml."
            )
        self.cost_limits = dict(limits)
        self.keys, values = parse_cost_limits(limits) if limits else ([], torch.empty(0))
        self.limits = values.to(device)
        self.tracker, self.risk = tracker, risk
        self.state_names = ("finished", "mean_length") if tracker is None else ("tracker",)
        if risk is not None:
            self.state_names = ("tracker", "risk")
        self.schedule = tracker.schedule if tracker is not None and self.keys else ""
        self._max_length, self._done_key = max_length, unravel_key(("next", done_key))
        # mean costs and length of episodes in the last batch in which an episode finished
        self.finished = torch.full_like(self.limits, torch.nan)
        self.mean_length = torch.full((), torch.nan, device=device)
        self._measured: MeasuredCosts | None = None

    @classmethod
    def from_config(cls, config: DictConfig, env: EnvBase) -> Self:
        """Build the constraints of a configuration; without any for an unconstrained algorithm.

        Lengths of episodes are in decisions (time steps of a batch), schedules in environment
        steps.

        Raises:
            ValueError: If a constrained algorithm has no limit, or a risk measure is named without
                a tracker.
        """
        limits = {key: float(limit) for key, limit in config.cost_limits.items()}
        if config.algo.constrained and not limits:
            raise ValueError(
                f"algo={config.algo.name} needs at least one entry in cost_limits, for example "
                "cost_limits='{cost: 25}'. Without constraints use algo=ppo or algo=sac."
            )
        max_length = math.ceil(env.max_episode_steps / env.steps_per_decision)
        if not config.algo.constrained:
            return cls({}, max_length=max_length, device=config.device)
        values = torch.tensor(list(limits.values()))
        known = {"steps_per_decision": env.steps_per_decision, "max_length": max_length}
        risk = instantiate(config.get("risk"), known, cost_limits=values)
        tracker = instantiate(config.get("limits"), known, cost_limits=values)
        return cls(limits, max_length=max_length, tracker=tracker, risk=risk, device=config.device)

    @property
    def measured_limits(self) -> dict[NestedKey, float]:
        """Limits of what is measured, by cost: d, or those of the risk measure."""
        limits = self.limits if self.risk is None else self.risk.measured_limits
        return dict(zip(self.keys, limits.tolist(), strict=True))

    def update(self, batch: TensorDictBase, episodes: EpisodeStatistics) -> LimitState:
        """Measure costs and violations from a batch, before the policy is updated.

        Args:
            batch: Steps of the current policy, [N, T], in order of time.
            episodes: Statistics of the episodes in the batch.

        Raises:
            KeyError: If the accounting of the episodes lacks a cost that has a limit.
            ValueError: If the batch or a cost has another shape.
        """
        if batch.ndim != 2:
            raise ValueError(
                f"The batch has the shape {list(batch.shape)}, and must have [N, T], environments "
                "and steps: batch.unsqueeze(0) of one environment's."
            )
        if self.tracker is None:
            return replace(self._compare_episodes(batch, episodes), keys=tuple(self.keys))
        columns = [batch["next", key] for key in self.keys]
        if any(column.shape != (*batch.shape, 1) for column in columns):
            raise ValueError(
                f"The costs {self.keys} must have the shape {[*batch.shape, 1]}, got "
                f"{[list(column.shape) for column in columns]}."
            )
        costs = torch.cat(columns, -1)
        if self.risk is not None:
            steps, ends = costs.cpu(), batch[self._done_key].squeeze(-1).cpu()
            before = torch.stack([episodes.open_costs[key_name(key)] for key in self.keys], -1)
            finished = episodes.episode_costs(self.keys).cpu()
            self._measured = self.risk(steps, ends, before.to(steps), finished)
        state = self.tracker.update(costs, episodes.decisions, self._measured)
        return replace(state.to(self.limits), keys=tuple(self.keys))

    def _compare_episodes(self, batch: TensorDictBase, episodes: EpisodeStatistics) -> LimitState:
        """Compare the mean of finished episodes with d.

        The length is the mean over the last batch in which an episode finished. J_c is that batch's
        mean too, if batches are at least as long as episodes. In shorter batches J_c is the cost
        rate times the length.
        """
        if episodes.num_episodes:
            self.finished = episodes.mean_costs(self.keys).to(self.finished)
            self.mean_length = episodes.decisions.mean().to(self.mean_length)
        costs, length = self.finished, self.mean_length
        has_finished = bool(length.isfinite())
        is_known = has_finished or self._max_length is not None
        if not has_finished:
            length = torch.full_like(length, float(self._max_length or batch.shape[-1]))
        goes_by_rate = batch.shape[-1] < float(length)
        if self.keys and is_known and (goes_by_rate or not has_finished):
            rates = [batch["next", key].to(costs).mean() for key in self.keys]
            costs = torch.stack(rates) * length
        is_new = goes_by_rate or episodes.num_episodes > 0
        return LimitState.of(cost=costs, limit=self.limits, length=length, is_new=is_new)

    def record_prediction(self, state: LimitState, metrics: Mapping[str, Tensor]) -> None:
        """Store the change of J_c that an update's surrogates predict, if it reports them.

        They are of the mean cost, so a change of a risk measure is not compared with them.
        """
        if self.tracker is not None and self.risk is None and "cost_surrogate" in metrics:
            change = metrics["cost_surrogate"] * state.length_for(state.cost)
            self.tracker.predictions.record_prediction(change)

    def columns(self, state: LimitState, multiplier: Multiplier | None) -> dict[str, float]:
        """Values of a batch and of λ, by name of their column in the run's table."""
        if self.tracker is None:
            row = self.column("violation", state.violation)
        else:
            row = self.column("estimate", state.cost) | self.column("target", state.target)
        if self._measured is not None:
            limit = self._measured.limit.to(state.cost)
            row |= self.column("violation", state.cost - limit)
        if multiplier is not None:
            row |= self.column("multiplier", multiplier.value)
        elif self.tracker is not None:
            row |= self.column("trust", state.realised_share)
        return row

    def column(self, name: str, value: Tensor) -> dict[str, float]:
        """Columns of the run's table: one for a scalar, one per constraint for a vector [k].

        A vector [1] counts as a scalar, unless there is exactly one constraint.

        Raises:
            ValueError: For any other shape.
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


def check_multiplier(multiplier: Multiplier | None, *nodes: DictConfig) -> None:
    """Refuse a multiplier that no part takes: the policy would not learn from costs."""
    takers = (parameters_of(locate(node._target_)) for node in nodes)
    if multiplier is not None and not any("multiplier" in names for names in takers):
        raise ValueError(
            f"lagrangian: {nodes[0]._target_} has no argument 'multiplier', so that it would have "
            "no effect. Derive the loss from one with a multiplier, or add '~lagrangian'."
        )


def check_cost_limits(
    cost_limits: Mapping[str, float], cost_keys: Sequence[str]
) -> dict[str, float]:
    """The limits as a plain dictionary, if the environment has every key.

    Raises:
        ValueError: If a key is unknown.
    """
    limits: dict[str, float] = {}
    for key, limit in cost_limits.items():
        if key not in cost_keys:
            raise ValueError(
                f"cost_limits names '{key}', but this environment has no such cost."
                f"{did_you_mean(key, cost_keys, 0.7)} It has {', '.join(cost_keys)}. In Safety "
                "Gym's environments env.constrain_<kind>=true adds others; with env=gymnasium, "
                "env.cost_keys=[…] names costs that the first step does not report."
            )
        limits[key] = float(limit)
    return limits
