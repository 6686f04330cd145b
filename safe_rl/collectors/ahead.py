"""Batches that are collected while the ones before are learned from."""

from __future__ import annotations

from collections.abc import Callable, Collection
from copy import deepcopy
from itertools import chain

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

__all__ = ["behind", "measured_from"]


def behind(
    policy: TensorDictModuleBase, sampled: Collection[NestedKey]
) -> tuple[TensorDictModuleBase, Callable[[], None], Callable[[TensorDictBase], TensorDictBase]]:
    """Let a copy of a policy collect while the policy itself learns.

    Args:
        policy: the policy that learns.
        sampled: keys of its actions.

    Returns:
        The copy; a function that gives it the present weights, to be called before anything is
        collected; and one for every batch, to be called while nothing is collected: the copy gets
        the present weights, and the batch is `measured_from` the present policy.

    Raises:
        ValueError: if the policy has a memory, which would be of older weights.
    """
    remembered = [key for key in policy.out_keys if isinstance(key, tuple) and key[0] == "next"]
    if remembered:
        raise ValueError(
            f"collector.ahead: a policy with a memory ({'.'.join(remembered[0])}) would go on from "
            "what older weights remember. Use collector.ahead=false."
        )
    copy = deepcopy(policy)

    def catch_up() -> None:
        _equate(copy, policy)

    def refresh(batch: TensorDictBase) -> TensorDictBase:
        catch_up()
        return measured_from(policy, batch, sampled)

    return copy, catch_up, refresh


@torch.no_grad()
def _equate(copy: nn.Module, policy: nn.Module) -> None:
    """Give a copy what its original holds by now, in place.

    A ``state_dict`` would leave out what belongs to no checkpoint of the network's, such as whether
    an `ExploringPolicy` still acts at random.
    """
    pairs = (chain(module.parameters(), module.buffers()) for module in (copy, policy))
    for own, present in zip(*pairs, strict=True):
        own.copy_(present)


@torch.no_grad()
def measured_from(
    policy: TensorDictModuleBase, batch: TensorDictBase, sampled: Collection[NestedKey]
) -> TensorDictBase:
    """Replace the parameters of the distributions that a batch was sampled from by the policy's.

    A batch that was collected ahead is of the policy before the last update. Its log-probabilities
    stay: samples are weighed by their ratio to these. But how far the next update goes is
    to be measured from where it starts.

    Args:
        policy: the present policy.
        batch: its inputs and, of an older policy, its outputs; any shape, changed in place.
        sampled: keys of actions, which stay as they are.

    Examples:
        >>> from tensordict import TensorDict
        >>> from safe_rl.models import BehaviourPolicy, make_actor
        >>> policy = BehaviourPolicy(make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5))
        >>> with torch.no_grad():
        ...     batch = policy(TensorDict(observation=torch.ones(5, 3), batch_size=[5]))
        ...     action = batch["action"].clone()
        ...     for parameter in policy.parameters():
        ...         _ = parameter.add_(1.0)  # an update
        >>> batch = measured_from(policy, batch, sampled=["action"])
        >>> torch.equal(batch["action"], action), batch["scale"][0]
        (True, tensor([1.6487, 1.6487]))
    """
    samples = batch.select(*policy.in_keys).reshape(-1)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        present = policy(samples)
    for key in policy.out_keys:
        name = key if isinstance(key, str) else key[-1]
        if key not in sampled and not name.endswith("log_prob"):
            batch[key] = present[key].reshape(batch[key].shape)
    return batch
