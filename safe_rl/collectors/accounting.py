"""Episode accounting: returns, episode costs and cost rates of the collected batches."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from safe_rl.naming import STEPS_TAKEN, key_name
from safe_rl.resumable import Resumable


class EpisodeError(ValueError):
    """Steps that break the rules of a constrained problem; the message says which."""


def check_steps(entries: Mapping[NestedKey, Tensor], cost_keys: Sequence[NestedKey]) -> None:
    """Refuse steps with NaN or infinite entries, or with costs below 0: nothing is learned of them.

    Entries are [N, T, …]; only floating-point numbers are checked. The host reads one tensor from
    the device, unless something is wrong.

    Raises:
        FloatingPointError: If an entry is not finite; the message names entry, row and step.
        EpisodeError: If a cost is below 0.
    """
    entries = {key: value for key, value in entries.items() if value.is_floating_point()}
    if not entries:
        return
    sums = [value.sum(dtype=torch.float64) for value in entries.values()]
    lowest = [entries[key].min().double() for key in cost_keys if key in entries]
    read = torch.stack([*sums, *lowest]).tolist()
    for key, total in zip(entries, read, strict=False):
        if math.isfinite(total):
            continue
        value = entries[key]
        wrong = ~value.reshape(*value.shape[:2], -1).isfinite().all(-1)
        row, step = wrong.nonzero()[0].tolist()
        where = f"environment {row}" + (f" at step {step}" if wrong.shape[1] > 1 else "")
        raise FloatingPointError(
            f"{key_name(key)!r} is not finite in {int(wrong.sum())} of {wrong.numel()} samples, "
            f"first in {where}. Nothing has been learned from them: look for the environment's "
            "first NaN or infinite number."
        )
    is_below = min(read[len(sums) :], default=0.0) < 0
    # `cost` last: where it is the sum of the others, one of them is the cause
    for key in sorted(cost_keys, key=lambda key: key == "cost") if is_below else ():
        if below := int((entries[key] < 0).sum()):
            raise EpisodeError(
                f"The cost '{key_name(key)}' is below 0 in {below} of {entries[key].numel()} "
                "steps. Costs must be 0 or more: clamp them in the environment, or add a constant "
                "to the cost of every step, and this constant times the length of an episode to "
                "the limit."
            )


@dataclass(frozen=True)
class EpisodeStatistics:
    """Statistics of the episodes in one batch.

    Attributes:
        returns: Undiscounted return of every episode that finished in the batch, shape [E].
        costs: Cost key -> undiscounted cost of every finished episode, shape [E]. Here and below,
            nested keys are joined by ``/``.
        lengths: Steps of every finished episode, shape [E].
        steps_per_decision: Environment steps per time step of a batch, which is one action.
        steps: Environment steps of the batch.
        cost_rates: Cost key -> all cost so far divided by all steps so far, ρ_c, scalar tensors.
        reward_rate: All reward so far divided by all steps so far, a scalar tensor.
        open_costs: Cost key -> cost that the unfinished episode of every row had before the batch,
            shape [N].

    Examples:
        >>> two = {"returns": torch.ones(2), "lengths": torch.full((2,), 1000.0)}
        >>> costs, rates = {"cost": torch.tensor([20.0, 40.0])}, {"cost": torch.tensor(0.03)}
        >>> EpisodeStatistics(costs=costs, cost_rates=rates, **two).mean_costs(["cost"])
        tensor([30.])
    """

    returns: Tensor
    costs: dict[str, Tensor]
    lengths: Tensor
    cost_rates: dict[str, Tensor]
    reward_rate: Tensor = field(default_factory=lambda: torch.tensor(torch.nan))
    open_costs: dict[str, Tensor] = field(default_factory=dict)
    steps_per_decision: int = 1
    steps: int = 0

    @property
    def num_episodes(self) -> int:
        """Number of episodes that finished in the batch, E."""
        return self.returns.shape[0]

    @property
    def decisions(self) -> Tensor:
        """Number of actions in every finished episode, [E]; the last may take fewer steps."""
        return (self.lengths / self.steps_per_decision).ceil()

    def episode_costs(self, cost_keys: Sequence[NestedKey]) -> Tensor:
        """Undiscounted costs of every finished episode, shape [E, len(cost_keys)].

        Raises:
            KeyError: If the accounting was not told of a cost.
        """
        for key in (key for key in cost_keys if key_name(key) not in self.costs):
            raise KeyError(f"There is no {key!r}: name it in EpisodeAccounting(…, cost_keys=[…]).")
        if not cost_keys:
            return self.returns.new_empty(self.num_episodes, 0)
        return torch.stack([self.costs[key_name(key)] for key in cost_keys], -1)

    def mean_costs(self, cost_keys: Sequence[NestedKey]) -> Tensor:
        """Mean episode cost J_c per key, shape [len(cost_keys)]; NaN if no episode finished."""
        return self.episode_costs(cost_keys).mean(0)

    def scalars(self) -> dict[str, float]:
        """Means, by name of their column in the run's table; NaN where no episode finished."""
        rows = {
            "episodes": float(self.num_episodes),
            "episode_return": self.returns.mean().item(),
            "episode_length": self.lengths.mean().item(),
        }
        rows |= {f"episode_{key}": costs.mean().item() for key, costs in self.costs.items()}
        rows["reward_rate"] = self.reward_rate.item()
        rows |= {f"{key}_rate": rate.item() for key, rate in self.cost_rates.items()}
        return rows


class EpisodeAccounting(Resumable):
    """Sum rewards and costs over episodes that may span any number of batches.

    The sums are taken over whole batches at once, after collection, so that environment steps take
    no longer.

    Args:
        num_envs: Number of environments N.
        cost_keys: Keys of the costs below ``"next"``, each [N, T, 1], or [T, 1] for one environment
            without a batch dimension.
        reward_key: Key of the reward below ``"next"``.
        done_key: Key of the end of an episode below ``"next"``.
        device: Device of the batches.
        longest: Largest number of steps of an episode, or None if it is not known.
        steps_per_decision: Environment steps per time step of a batch. If it is not 1,
            ``steps_taken`` below ``"next"`` has the number of each time step.

    Examples:
        >>> from tensordict import TensorDict
        >>> accounting = EpisodeAccounting(num_envs=1, cost_keys=["cost"])
        >>> done = torch.tensor([[[False], [True], [False]]])
        >>> step = {"reward": torch.ones(1, 3, 1), "cost": torch.ones(1, 3, 1), "done": done}
        >>> batch = TensorDict({"next": step}, [1, 3])
        >>> accounting.update(batch).costs["cost"]  # one episode, two steps long
        tensor([2.], dtype=torch.float64)
        >>> accounting.update(batch).costs["cost"]  # its first step was in the last batch
        tensor([3.], dtype=torch.float64)
    """

    state_names = ("open_sums", "totals")

    def __init__(
        self,
        num_envs: int,
        cost_keys: Sequence[NestedKey],
        *,
        reward_key: NestedKey = "reward",
        done_key: NestedKey = "done",
        device: torch.device | str | None = None,
        longest: int | None = None,
        steps_per_decision: int = 1,
    ) -> None:
        self.longest, self.steps_per_decision = longest, steps_per_decision
        self.cost_keys = list(cost_keys)
        for key in {"return", "length"} & {key_name(key) for key in self.cost_keys}:
            raise ValueError(f"A cost cannot be named '{key}': episode_{key} is another column.")
        self.done_key = done_key
        self._signal_keys = [reward_key, *self.cost_keys]
        num_sums = 1 + len(self._signal_keys)
        # in float64, sums of indicator costs are exact, and how steps are divided into batches
        # changes sums of rewards far less than the digits that are logged
        self.open_sums = torch.zeros(num_envs, num_sums, dtype=torch.float64, device=device)
        self.totals = torch.zeros(num_sums, dtype=torch.float64, device=device)
        self._last_ids: Tensor | None = None

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore the sums.

        Raises:
            ValueError: If numbers of steps or costs are below 0, or sums are not finite. Only the
                number of steps of an episode that is left out is NaN.
        """
        super().load_state_dict(state_dict)
        self._last_ids = None
        sums = torch.cat([self.open_sums, self.totals[None]])
        sums[:-1, 0].masked_fill_(sums[:-1, 0].isnan(), 0.0)
        # the second column has rewards
        if not sums.isfinite().all() or (sums[:, [0, *range(2, sums.shape[1])]] < 0).any():
            raise ValueError("sums of steps and costs must be finite and not below 0.")

    def update(self, batch: TensorDictBase) -> EpisodeStatistics:
        """Add the next batch of consecutive steps, [N, T], or [T] of a single environment.

        Raises:
            KeyError: If a key is not in the batch.
            EpisodeError: If a cost is below 0, or an episode too long.
            FloatingPointError: If an observation, action, reward or cost is NaN or infinite.
            ValueError: If the batch has another shape, padding, or steps that do not follow each
                other or the last batch, or an entry is not one number per step.
        """
        num_envs = self.open_sums.shape[0]
        if batch.ndim == num_envs == 1:
            batch = batch.unsqueeze(0)
        if batch.ndim != 2 or batch.shape[0] != num_envs:
            raise ValueError(
                f"The batch has shape {list(batch.shape)}, but the accounting is for {num_envs} "
                f"environments: it needs [{num_envs}, T], as the collector returns it (of several "
                "workers with cat_results=0)."
            )
        done = self._column(batch, self.done_key).long()
        self._check_continues(batch, done)
        columns = {key: self._column(batch, key) for key in self._signal_keys}
        observed = batch.select("observation", ("next", "observation"), strict=False)
        # actions last: a policy that observes NaN acts with NaN
        acted = {} if (action := batch.get("action", None)) is None else {"action": action}
        check_steps({**dict(observed.items(True, True)), **columns, **acted}, self.cost_keys)
        signals = torch.stack(list(columns.values()), -1)
        steps, num_steps = torch.ones_like(signals[..., 0]), batch.numel()
        if self.steps_per_decision != 1:
            steps = self._column(batch, STEPS_TAKEN)
            num_steps = int(steps.sum())
        signals = torch.cat([steps.unsqueeze(-1), signals], -1)
        before = self.open_sums[:, 2:]
        finished = self._close_episodes(signals, done)
        finished = finished[finished[:, 0].isfinite()]
        longest = torch.cat([finished[:, 0], self.open_sums[:, 0]]).nan_to_num().max().item()
        if self.longest is not None and longest > self.longest:
            raise EpisodeError(
                f"An episode has {longest:g} steps, but the environment's 'max_episode_steps' is "
                f"{self.longest}: it has to end episodes itself ('done' and 'truncated'), and its "
                "reset may only begin episodes in the rows that '_reset' names."
            )
        self.totals += signals.sum((0, 1))
        names = [key_name(key) for key in self.cost_keys]
        reward_rate, *rates = self.totals[1:] / self.totals[0]
        return EpisodeStatistics(
            returns=finished[:, 1],
            costs=dict(zip(names, finished[:, 2:].unbind(-1), strict=True)),
            lengths=finished[:, 0],
            cost_rates=dict(zip(names, rates, strict=True)),
            reward_rate=reward_rate,
            open_costs=dict(zip(names, before.unbind(-1), strict=True)),
            steps_per_decision=self.steps_per_decision,
            steps=num_steps,
        )

    def _check_continues(self, batch: TensorDictBase, done: Tensor) -> None:
        """Refuse padding, and steps that are not of the same episodes as those before them."""
        mask = batch.get(("collector", "mask"), None)
        if mask is not None and not mask.all():
            raise ValueError(
                "The batch has padding, which would count as steps: use the collector with "
                "split_trajs=False."
            )
        ids = batch.get(("collector", "traj_ids"), None)
        if ids is None:
            return
        ids = ids.reshape(batch.shape)
        last = ids[:, 0] if self._last_ids is None else self._last_ids
        is_another = ids != torch.cat([last.unsqueeze(1), ids[:, :-1]], 1)
        goes_on = torch.cat([self.have_begun.unsqueeze(1), done[:, :-1] == 0], 1)
        if (is_another & goes_on).any():
            raise ValueError(
                "Steps do not continue the episodes of those before them, in this batch or the "
                "last one: several episodes would be summed up as one. An asynchronous collector "
                "returns batches of its workers in turn: use MultiSyncCollector with "
                "cat_results=0. If the environments have been reset, call forget_open_episodes() "
                "before."
            )
        if self._last_ids is not None and not (is_another | goes_on)[:, 0].all():
            raise ValueError(
                "Episodes go on that had ended ('done') in the last batch: use the collector with "
                "set_truncated=False."
            )
        self._last_ids = ids[:, -1].clone()

    def _close_episodes(self, signals: Tensor, done: Tensor) -> Tensor:
        """Sums of the finished episodes, [E, m], from signals [N, T, m] and done [N, T]."""
        num_envs, _, num_sums = signals.shape
        num_done = done.sum(1)
        # index of the episode that each step belongs to, counted from the batch's first step
        episode = done.cumsum(1) - done
        sums = signals.new_zeros(num_envs, int(num_done.max()) + 1, num_sums)
        sums[:, 0] = self.open_sums
        sums.scatter_add_(1, episode.unsqueeze(-1).expand_as(signals), signals)
        is_finished = torch.arange(sums.shape[1], device=sums.device) < num_done.unsqueeze(1)
        last = num_done.view(-1, 1, 1).expand(-1, 1, num_sums)
        self.open_sums = sums.gather(1, last).squeeze(1)
        return sums[is_finished]

    @staticmethod
    def _column(batch: TensorDictBase, key: NestedKey) -> Tensor:
        """Entry below "next" as float64, shape [N, T]."""
        entry = batch.get(unravel_key(("next", key)), None)
        if entry is None:
            known = sorted(map(str, batch.get("next").keys(True, True)))
            raise KeyError(f"The batch has no ('next', {key!r}). What it has there: {known}.")
        if entry.numel() != batch.numel():
            raise ValueError(
                f"('next', {key!r}) has the shape {list(entry.shape)}, expected "
                f"{[*batch.shape, 1]}: one number per step. Of several agents, sum them up."
            )
        return entry.reshape(batch.shape).double()

    @property
    def have_begun(self) -> Tensor:
        """Rows [N] whose episode is unfinished at the end of the last batch, bool."""
        return self.open_sums[:, 0] != 0

    def forget_open_episodes(self) -> None:
        """Drop the sums of unfinished episodes: the environment starts new ones."""
        self.open_sums.zero_()
        self._last_ids = None

    def ignore_open_episodes(self) -> None:
        """Leave the present episodes, whose first steps are missing, out of all statistics."""
        # costs are known: risk measures charge every step of these episodes, too
        self.open_sums.zero_()[:, 0] = torch.nan
        self._last_ids = None
