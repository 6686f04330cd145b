"""Generalised advantage estimates for the reward and for k costs at once.

Rollouts are [..., T] TensorDicts; time is the last dimension. A trajectory ends where
``("next", "done")`` is set, at the last step of the batch, and where the mask of a padded rollout
ends or ``traj_ids`` change. Unless it ends with ``("next", "terminated")``, the value of its last
observation is bootstrapped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.value import ValueEstimatorBase

from safe_rl.checks import Checked, Share
from safe_rl.objectives.gae import gae, normalise_advantages, trajectory_ends
from safe_rl.objectives.samples import FIRST, require, sample_mask


class VectorGAE(Checked, ValueEstimatorBase):
    """Advantages and value targets of one or several reward-like signals.

    It differs from `torchrl.objectives.value.GAE` in three points: it takes several signals at
    once, it evaluates every observation once, and it has a choice of value targets.

    Args:
        value_network: Critic, which writes the value key, [..., T, F], one output per signal; None
            if the values are in the TensorDict already, at the root and under ``"next"``. At the
            ends of trajectories, a recurrent critic (with an ``LSTMModule``) reads its recurrent
            state from the rollout.
        gamma: Discount per step.
        lmbda: Decay λ of the TD errors in generalised advantage estimation.
        value_target: Target of the critics: ``"lambda_return"`` (advantage + value) or
            ``"return_to_go"`` (discounted sum of the signal to the trajectory's end, bootstrapped
            there unless it terminated).

    Examples:
        >>> from safe_rl.models import make_critic
        >>> settings = {"gamma": 0.99, "lmbda": 0.97, "value_target": "lambda_return"}
        >>> VectorGAE(make_critic(3, hidden_sizes=[8]), **settings).in_keys[:3]
        ['observation', ('next', 'observation'), ('next', 'reward')]
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` accepts: three outputs, and three entries under ``"next"``."""

        advantage: NestedKey = "advantage"  # [..., T, F]
        value_target: NestedKey = "value_target"  # [..., T, F]
        value: NestedKey = "state_value"  # of an observation, [..., T, F]
        reward: NestedKey | list[NestedKey] = "reward"  # one key or several, [..., T, 1] each
        done: NestedKey = "done"  # [..., T, 1] bool
        terminated: NestedKey = "terminated"  # [..., T, 1] bool

    default_keys: type = _AcceptedKeys

    def __init__(
        self,
        value_network: TensorDictModuleBase | None,
        *,
        gamma: Share,
        lmbda: Share,
        value_target: Literal["lambda_return", "return_to_go"],
    ) -> None:
        super().__init__(value_network=value_network)
        self.gamma, self.lmbda, self.value_target = gamma, lmbda, value_target

    @property
    def reward_keys(self) -> list[NestedKey]:
        """Keys of the signals, without ``"next"``, in the order of the F outputs."""
        reward = self.tensor_keys.reward
        return list(reward) if isinstance(reward, list) else [reward]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries of the rollout that are read."""
        network = self.value_network
        observed = [self.tensor_keys.value] if network is None else list(network.in_keys)
        ends = [self.tensor_keys.done, self.tensor_keys.terminated]
        following = [*observed, *self.reward_keys, *ends]
        return [*observed, *(unravel_key(("next", key)) for key in following)]

    @dispatch
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write values, advantages and value targets into a rollout; they are 0 in padding.

        Args:
            tensordict: Rollout [..., T] with `in_keys`, or these entries as keyword arguments.

        Raises:
            KeyError: If an entry is missing.
            ValueError: If values, signals and ends do not match in shape, if there is a dimension
                between time and the signals, or if another dimension has the name ``"time"``.
        """
        keys = self.tensor_keys
        if self._get_time_dim(None, tensordict) != tensordict.ndim - 1:
            raise ValueError(f"'time' must be the last of the dimensions {tensordict.names}.")
        signals = [require(tensordict, ("next", key)) for key in self.reward_keys]
        done, terminated = (
            require(tensordict, ("next", key)) for key in (keys.done, keys.terminated)
        )
        shapes = [list(signal.shape) for signal in signals]
        unlike = any(shape[:-1] != list(done.shape[:-1]) for shape in shapes)
        if unlike or done.ndim > tensordict.ndim + 1:
            raise ValueError(
                f"In a rollout {list(tensordict.batch_size)}, the signals {self.reward_keys} have "
                f"the shapes {shapes} and {keys.done!r} {list(done.shape)}: all must be "
                "[..., T, 1]. If the last dimension is missing, as in infos that TorchRL's GymEnv "
                "reads, use unsqueeze(-1). Of several agents, make rows: [..., agents, T]."
            )
        reward = torch.cat(signals, -1)
        mask = sample_mask(tensordict)
        ends = trajectory_ends(done, mask, tensordict.get(("collector", "traj_ids"), None))
        value, next_value = self._values(tensordict, ends)
        if value.shape != reward.shape:
            raise ValueError(
                f"{keys.value!r} has shape {tuple(value.shape)} but the signals "
                f"{self.reward_keys} have {tuple(reward.shape)}: the value network needs one "
                "output per signal."
            )
        done = ends.unsqueeze(-1)
        if mask is not None:
            padded = ~mask.unsqueeze(-1)
            reward, value, next_value = (
                signal.masked_fill(padded, 0.0) for signal in (reward, value, next_value)
            )
        estimate = partial(gae, reward, value, next_value, done, terminated, gamma=self.gamma)
        advantage = estimate(lmbda=self.lmbda)
        # With λ = 1 the TD errors telescope: advantage + value is the bootstrapped return.
        to_go = self.value_target == "return_to_go"
        target = value + (estimate(lmbda=1.0) if to_go else advantage)
        if mask is not None:
            advantage, target = (x.masked_fill(padded, 0.0) for x in (advantage, target))
        tensordict.set(keys.value, value)
        tensordict.set(keys.advantage, advantage)
        return tensordict.set(keys.value_target, target)

    def _values(self, tensordict: TensorDictBase, ends: Tensor) -> tuple[Tensor, Tensor]:
        """Values of the observations and of the next observations, both [..., T, F].

        Inside a trajectory the next observation of step t is the root observation of step t + 1. So
        only the last observations of trajectories, where `ends` is set, are evaluated in addition.
        A recurrent network reads the rollout as sequences, and the last observations as sequences
        of one step with their recurrent states.
        """
        key, network = self.tensor_keys.value, self.value_network
        if network is None:
            hint = "With value_network=None the values must be there before."
            following = require(tensordict, ("next", key), hint)
            return require(tensordict, key, hint), following
        last = tensordict.get("next").select(*network.in_keys)[ends]
        if FIRST in network.in_keys:
            last = last.unsqueeze(-1)
        with set_recurrent_mode(True):
            value = require(network(tensordict.select(*network.in_keys)), key)
            value_at_ends = network(last).get(key)
        next_value = value.roll(-1, dims=-2)
        next_value[ends] = value_at_ends.reshape(-1, value.shape[-1])
        return value, next_value


class CostGAE(VectorGAE):
    """`VectorGAE` for k costs: writes ``cost_advantage``, ``cost_value_target``, ``cost_value``.

    Args:
        cost_keys: Keys of the costs under ``"next"``, in the order of the k outputs and of the
            limits: columns have no names, so another order is not noticed.
        value_network: Cost critic, which writes ``cost_value`` [..., T, k]; None: see `VectorGAE`.
        settings: ``gamma``, ``lmbda`` and ``value_target``, see `VectorGAE`.

    Raises:
        ValueError: If ``cost_keys`` is empty, or a text.

    Examples:
        >>> settings = {"gamma": 0.99, "lmbda": 0.97, "value_target": "return_to_go"}
        >>> CostGAE(["cost_hazards", "cost_vases_contact"], None, **settings).out_keys
        ['cost_advantage', 'cost_value_target']
    """

    @dataclass
    class _AcceptedKeys:  # not inherited: TorchRL looks for names in the class itself
        """Keys that `set_keys` accepts: see `VectorGAE`."""

        advantage: NestedKey = "cost_advantage"
        value_target: NestedKey = "cost_value_target"
        value: NestedKey = "cost_value"
        reward: NestedKey | list[NestedKey] = "cost"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys

    def __init__(
        self,
        cost_keys: Sequence[NestedKey],
        value_network: TensorDictModuleBase | None,
        **settings: Any,
    ) -> None:
        super().__init__(value_network, **settings)
        if not cost_keys or isinstance(cost_keys, str):
            raise ValueError("cost_keys must be a list with at least one cost, such as ['cost'].")
        self.set_keys(reward=list(cost_keys))


class JointAdvantages(TensorDictModuleBase):
    """Normalised advantages of the reward and of the costs, in one call per batch.

    TorchRL's trainers accept it in place of their `GAE`.

    Args:
        reward: Estimator of the reward advantage.
        cost: Estimator of the cost advantages, or None.

    Examples:
        >>> settings = {"gamma": 0.99, "lmbda": 0.97, "value_target": "lambda_return"}
        >>> reward, cost = VectorGAE(None, **settings), CostGAE(["cost"], None, **settings)
        >>> JointAdvantages(reward, cost).out_keys
        ['advantage', 'value_target', 'cost_advantage', 'cost_value_target']
    """

    def __init__(self, reward: VectorGAE, cost: CostGAE | None = None) -> None:
        super().__init__()
        self.reward, self.cost = reward, cost

    @property
    def _estimators(self) -> list[VectorGAE]:
        return [part for part in (self.reward, self.cost) if part is not None]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries of the rollout that are read."""
        return list(dict.fromkeys(key for part in self._estimators for key in part.in_keys))

    @property
    def out_keys(self) -> list[NestedKey]:
        """Entries that are written."""
        return [key for part in self._estimators for key in part.out_keys]

    def set_keys(self, **kwargs: Any) -> None:
        """Set keys of the reward's estimator; ``done`` and ``terminated`` also of the costs'."""
        self.reward.set_keys(**kwargs)
        if self.cost is not None:
            ends = {name: kwargs[name] for name in ("done", "terminated") if name in kwargs}
            self.cost.set_keys(**ends)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write advantages and value targets into a rollout [..., T], and return it."""
        self.reward(tensordict)
        keys = {"advantage": self.reward.tensor_keys.advantage}
        if self.cost is not None:
            self.cost(tensordict)
            keys["cost_advantage"] = self.cost.tensor_keys.advantage
        return normalise_advantages(tensordict, **keys)
