"""One epoch of constrained policy optimisation, put together from interchangeable parts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor

from safe_rl.algorithms.minibatch import MinibatchUpdate, PolicyUpdate
from safe_rl.collectors import EpisodeStatistics
from safe_rl.objectives.advantages import CostGAE, VectorGAE
from safe_rl.objectives.multipliers import Multiplier
from safe_rl.objectives.normalisation import normalise_advantages

__all__ = ["Algorithm", "Networks", "mean_cost"]


def mean_cost(episode_costs: Tensor) -> Tensor:
    """J_c, the mean over episodes: [E, k] -> [k]."""
    return episode_costs.mean(0)


@dataclass
class Networks:
    """What is trained.

    Attributes:
        actor: Policy with ``get_dist``.
        critic: Writes ``state_value``, [..., 1].
        cost_critic: Writes ``cost_value``, [..., k]; None if the algorithm has no constraints.
    """

    actor: ProbabilisticTensorDictSequential
    critic: TensorDictModule
    cost_critic: TensorDictModule | None


@dataclass
class Algorithm:
    """Advantages, multiplier, policy update, value fitting: in this order, once per epoch.

    Attributes:
        networks: What is trained.
        cost_keys: Keys of the k constrained costs; empty for an unconstrained algorithm.
        cost_limits: d of every constraint, undiscounted cost per episode, shape [k].
        cost_measure: What of the episode costs, [E, k], is held against the limits, [k]:
            `mean_cost`, or another statistic, such as a quantile. Its gradient is up to
            `cost_advantage`.
        advantage: Estimator of the reward advantage, with the critic.
        cost_advantage: Estimator of the cost advantages, with the cost critic, or None.
        multiplier: Weighs the costs against the return, or None.
        policy_update: Improves the actor.
        critic_update: Fits the critics.
    """

    networks: Networks
    cost_keys: Sequence[str]
    cost_limits: Tensor
    cost_measure: Callable[[Tensor], Tensor]
    advantage: VectorGAE
    cost_advantage: CostGAE | None
    multiplier: Multiplier | None
    policy_update: PolicyUpdate
    critic_update: MinibatchUpdate

    def __post_init__(self) -> None:
        """Start without any knowledge of the episode costs."""
        self._costs = torch.full_like(self.cost_limits, torch.nan)
        self._mean_length = torch.full((), torch.nan, device=self.cost_limits.device)

    def learn(self, batch: TensorDictBase, episodes: EpisodeStatistics) -> dict[str, float]:
        """Train on one batch.

        Args:
            batch: Rollouts of the current policy, [N, T]; advantages are written into it.
            episodes: Its episodes.

        Returns:
            Everything that is worth a column of the log, by column name.
        """
        self.advantage(batch)
        if self.cost_advantage is not None:
            self.cost_advantage(batch)
        normalise_advantages(batch)

        violation, length = self._constraint_state(batch, episodes)
        if self.multiplier is not None and episodes.num_episodes:
            self.multiplier.update(self._costs)
        policy = self.policy_update(batch, violation, length)
        critic = self.critic_update(batch)
        return self._scalars(violation, policy, critic)

    def _constraint_state(
        self, batch: TensorDictBase, episodes: EpisodeStatistics
    ) -> tuple[Tensor, Tensor]:
        """J_c − d, shape [k], and the mean episode length T̄; J_c as `cost_measure` has it.

        Both are those of the last batch in which an episode finished. Before there is one, the
        length is that of the batch and the cost what the batch's cost rate would sum to in it.
        """
        device = self.cost_limits.device
        if episodes.num_episodes:
            costs = self.cost_measure(episodes.episode_costs(self.cost_keys))
            self._costs = costs.to(self.cost_limits)
            self._mean_length = episodes.lengths.mean().to(device, torch.float32)
        if self._mean_length.isfinite():
            return self._costs - self.cost_limits, self._mean_length
        length = torch.tensor(float(batch.shape[-1]), device=device)
        rates = [episodes.cost_rates[key].to(device) for key in self.cost_keys]
        costs = torch.stack(rates) * length if rates else self._costs
        return costs.float() - self.cost_limits, length

    def _scalars(
        self, violation: Tensor, policy: Mapping[str, Tensor], critic: Mapping[str, Tensor]
    ) -> dict[str, float]:
        row = self._columns("violation", violation)
        if self.multiplier is not None:
            row |= self._columns("multiplier", self.multiplier.value)
        for part, metrics in (("policy", policy), ("critic", critic)):
            for name, value in metrics.items():
                row |= self._columns(f"{part}_{name}", torch.as_tensor(value))
        return row

    def _columns(self, name: str, value: Tensor) -> dict[str, float]:
        """One column for a scalar, one per constraint for a vector [k]."""
        if value.ndim == 0:
            return {name: value.item()}
        return {
            f"{name}_{key}": entry
            for key, entry in zip(self.cost_keys, value.tolist(), strict=True)
        }

    def checkpoint_components(self) -> dict[str, Any]:
        """Parts with a ``state_dict``, by name: together they are all that learning depends on."""
        parts = {
            "actor": self.networks.actor,
            "critic": self.networks.critic,
            "cost_critic": self.networks.cost_critic,
            "multiplier": self.multiplier,
            "policy_update": self.policy_update,
            "critic_update": self.critic_update,
            "algorithm": self,
        }
        return {name: part for name, part in parts.items() if part is not None}

    def state_dict(self) -> dict[str, Tensor]:
        """The costs and the length of the last batch in which an episode finished."""
        return {"costs": self._costs, "mean_length": self._mean_length}

    def load_state_dict(self, state_dict: Mapping[str, Tensor]) -> None:
        """Continue from :meth:`state_dict`."""
        self._costs = state_dict["costs"].to(self._costs)
        self._mean_length = state_dict["mean_length"].to(self._mean_length)
