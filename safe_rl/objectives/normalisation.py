"""Normalisation of advantages over a batch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from safe_rl.objectives.keys import require
from safe_rl.objectives.samples import sample_mask


def standardise(advantage: Tensor, eps: float = 1e-8) -> Tensor:
    """Shift and scale to mean 0 and (population) standard deviation 1."""
    centred = advantage - advantage.mean()
    return centred / centred.square().mean().sqrt().clamp_min(eps)


def centre(advantage: Tensor) -> Tensor:
    """Shift each of k signals [..., k] to mean 0 over the batch."""
    return advantage - advantage.flatten(0, -2).mean(0)


def _of_samples(
    change: Callable[[Tensor], Tensor], advantage: Tensor, mask: Tensor | None
) -> Tensor:
    """Apply a change to the samples alone; padding becomes 0."""
    if mask is None:
        return change(advantage)
    changed = torch.zeros_like(advantage)
    changed[mask] = change(advantage[mask])
    return changed


def normalise_advantages(
    tensordict: TensorDictBase,
    *,
    advantage: NestedKey = "advantage",
    cost_advantage: NestedKey = "cost_advantage",
) -> TensorDictBase:
    """Standardise the reward advantage and centre the cost advantages, in place.

    Cost advantages are never rescaled: their size against the standardised reward advantage is
    what a multiplier acts on, and in CPO it carries the units of the constraint. Padding, by the
    mask of TorchRL's collectors, counts for nothing.

    Args:
        tensordict: batch of any shape with `advantage` [..., 1] and, if there are costs,
            `cost_advantage` [..., k].
        advantage: key of the reward advantage.
        cost_advantage: key of the cost advantages.

    Returns:
        The same TensorDict.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> batch = TensorDict(
        ...     advantage=torch.tensor([[1.0], [3.0]]),
        ...     cost_advantage=torch.tensor([[4.0], [8.0]]),
        ...     batch_size=[2],
        ... )
        >>> normalise_advantages(batch)["cost_advantage"].squeeze(-1)
        tensor([-2.,  2.])
    """
    mask = sample_mask(tensordict)
    tensordict.set(advantage, _of_samples(standardise, require(tensordict, advantage), mask))
    costs = tensordict.get(cost_advantage, None)
    if costs is not None:
        tensordict.set(cost_advantage, _of_samples(centre, costs, mask))
    return tensordict
