"""Generalised advantage estimates for the reward and for k costs at once.

Rollouts are [..., T] TensorDicts, time last (collectors give [N, T]); a trajectory ends where
``("next", "done")`` is set and at the last step of the batch. Where it ends without
``("next", "terminated")`` (time-out, or end of the batch) its last observation is bootstrapped.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Literal, get_args

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.objectives.value import ValueEstimatorBase
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from safe_rl.objectives.keys import require

ValueTarget = Literal["lambda_return", "return_to_go"]


def one_pass_values(
    tensordict: TensorDictBase, value_network: TensorDictModuleBase, key: NestedKey, done: Tensor
) -> tuple[Tensor, Tensor]:
    """Value every observation of a rollout once.

    Inside a trajectory the next observation of step t is the root observation of step t + 1,
    so that only the observations at which trajectories end are valued in addition.

    Args:
        tensordict: rollout [..., T] with the network's in_keys, also under ``"next"``.
        value_network: writes `key`, [..., T, F].
        key: the network's value key.
        done: [..., T, 1] bool.

    Returns:
        Values of the root observations and of the next observations, both [..., T, F].
    """
    ends = done.squeeze(-1).clone()
    ends[..., -1] = True
    value = value_network(tensordict.select(*value_network.in_keys)).get(key)
    last = tensordict.get("next").select(*value_network.in_keys)[ends]
    next_value = value.roll(-1, dims=-2)
    next_value[ends] = value_network(last).get(key)
    return value, next_value


def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    done: Tensor,
    terminated: Tensor,
    *,
    gamma: float,
    lmbda: float,
) -> Tensor:
    """Generalised advantage estimate (Schulman et al. 2016, equation 16).

    Args:
        reward: [..., T, F], F reward-like signals.
        value: [..., T, F], values of the observations.
        next_value: [..., T, F], values of the next observations.
        done: [..., T, 1] bool, trajectory ends.
        terminated: [..., T, 1] bool, ends without bootstrap.
        gamma: discount per step.
        lmbda: decay of the TD errors.

    Returns:
        Advantages, [..., T, F].
    """
    if gamma * lmbda == 0:
        # TorchRL's filter drops even the first TD error when the decay is 0.
        return reward + gamma * next_value * ~terminated - value
    flags = done.expand_as(reward), terminated.expand_as(reward)
    return vec_generalized_advantage_estimate(gamma, lmbda, value, next_value, reward, *flags)[0]


class VectorGAE(ValueEstimatorBase):
    """Advantages and value targets of one or several reward-like signals.

    Differs from `torchrl.objectives.value.GAE` in three points: several signals at once, every
    observation valued once, and a choice of value target.

    Args:
        value_network: writes the value key, [..., T, F], one output per signal; None if the
            values are in the TensorDict already, at the root and under ``"next"``.
        gamma: discount per step.
        lmbda: decay of the TD errors.
        value_target: ``"lambda_return"`` (advantage + value) or ``"return_to_go"`` (discounted
            sum of the signal to the trajectory's end, bootstrapped there unless it terminated).

    Raises:
        ValueError: if `value_target` is neither of the two.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> critic = TensorDictModule(
        ...     torch.nn.Linear(3, 1), in_keys=["observation"], out_keys=["state_value"]
        ... )
        >>> estimator = VectorGAE(critic, gamma=0.99, lmbda=0.97, value_target="lambda_return")
        >>> next = TensorDict(
        ...     observation=torch.randn(2, 10, 3),
        ...     reward=torch.randn(2, 10, 1),
        ...     done=torch.zeros(2, 10, 1, dtype=torch.bool),
        ...     terminated=torch.zeros(2, 10, 1, dtype=torch.bool),
        ... )
        >>> rollout = TensorDict(observation=torch.randn(2, 10, 3), next=next, batch_size=[2, 10])
        >>> estimator(rollout)["advantage"].shape
        torch.Size([2, 10, 1])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` accepts.

        Attributes:
            advantage: output, [..., T, F].
            value_target: output, [..., T, F].
            value: value of an observation, [..., T, F].
            reward: signal(s) under ``"next"``, [..., T, 1] each: one key or a list of keys.
            done: under ``"next"``, [..., T, 1] bool.
            terminated: under ``"next"``, [..., T, 1] bool.
        """

        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        reward: NestedKey | list[NestedKey] = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys: type = _AcceptedKeys

    def __init__(
        self,
        value_network: TensorDictModuleBase | None,
        *,
        gamma: float,
        lmbda: float,
        value_target: ValueTarget,
    ) -> None:
        if value_target not in get_args(ValueTarget):
            raise ValueError(
                f"value_target must be one of {get_args(ValueTarget)}, got {value_target!r}."
            )
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

    @torch.no_grad()
    def forward(
        self,
        tensordict: TensorDictBase,
        *,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
    ) -> TensorDictBase:
        """Write advantages and value targets into a rollout.

        Args:
            tensordict: rollout [..., T] with `in_keys`.
            params: parameters to run the value network with instead of its own.
            target_params: must be None; a single pass knows a single set of parameters.

        Returns:
            The same TensorDict, with ``advantage``, ``value_target`` and ``value``.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if values and signals do not match in shape, or `target_params` is given.
        """
        if target_params is not None:
            raise ValueError("target_params needs two passes: use torchrl.objectives.value.GAE.")
        keys = self.tensor_keys
        signals = [require(tensordict, ("next", key)) for key in self.reward_keys]
        reward = torch.cat(signals, -1)
        done, terminated = (
            require(tensordict, ("next", key)) for key in (keys.done, keys.terminated)
        )
        value, next_value = self._values(tensordict, done, params)
        if value.shape != reward.shape:
            raise ValueError(
                f"{keys.value!r} has shape {tuple(value.shape)} but the signals "
                f"{self.reward_keys} have {tuple(reward.shape)}: the value network needs one "
                "output per signal."
            )
        estimate = partial(gae, reward, value, next_value, done, terminated, gamma=self.gamma)
        advantage = estimate(lmbda=self.lmbda)
        # With λ = 1 the TD errors telescope: advantage + value is the bootstrapped return.
        to_go = self.value_target == "return_to_go"
        target = value + (estimate(lmbda=1.0) if to_go else advantage)
        tensordict.set(keys.value, value)
        tensordict.set(keys.advantage, advantage)
        return tensordict.set(keys.value_target, target)

    def _values(
        self, tensordict: TensorDictBase, done: Tensor, params: TensorDictBase | None
    ) -> tuple[Tensor, Tensor]:
        key, network = self.tensor_keys.value, self.value_network
        if network is None:
            hint = "With value_network=None the values must be there before."
            following = require(tensordict, ("next", key), hint)
            return require(tensordict, key, hint), following
        with nullcontext() if params is None else params.to_module(network):
            return one_pass_values(tensordict, network, key, done)


class CostGAE(VectorGAE):
    """`VectorGAE` for k costs, with the cost keys as defaults.

    Writes ``cost_advantage``, ``cost_value_target`` and ``cost_value``, [..., T, k].

    Args:
        cost_keys: keys of the costs under ``"next"``, in the order of the k outputs.
        value_network: cost critic, writes ``cost_value`` [..., T, k]; or None.
        gamma: discount per step.
        lmbda: decay of the TD errors.
        value_target: as in `VectorGAE`.

    Examples:
        >>> estimator = CostGAE(
        ...     ["cost_hazards", "cost_vases_contact"],
        ...     None,
        ...     gamma=0.99,
        ...     lmbda=0.97,
        ...     value_target="return_to_go",
        ... )
        >>> estimator.out_keys
        ['cost_advantage', 'cost_value_target']
    """

    @dataclass
    class _AcceptedKeys:
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
        *,
        gamma: float,
        lmbda: float,
        value_target: ValueTarget,
    ) -> None:
        super().__init__(value_network, gamma=gamma, lmbda=lmbda, value_target=value_target)
        self.set_keys(reward=list(cost_keys))
