"""Parts of advantage estimators: ends of trajectories, estimates and normalisation."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from safe_rl.objectives.samples import require, sample_mask


def trajectory_ends(done: Tensor, mask: Tensor | None, ids: Tensor | None) -> Tensor:
    """Where the trajectories of a rollout end, [..., T] bool, from ``done`` [..., T, 1].

    The mask [..., T] is False where the rollout is padded; None without padding. The collector's
    ids of trajectories, or None, say where one follows another that has not ended: in rollouts that
    were flattened, or in those of several workers behind each other.
    """
    ends = done.squeeze(-1).clone()
    ends[..., -1] = True
    if ids is not None:
        ids = ids.reshape(ends.shape)
        ends |= ids != ids.roll(-1, -1)
    return ends if mask is None else (ends | ~mask.roll(-1, -1)) & mask


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

    Advantages and their arguments are [..., T, F] for F reward-like signals. The flags are
    [..., T, 1]; where `terminated` is set, values are not bootstrapped.
    """
    if gamma * lmbda == 0:
        # With a decay of 0, TorchRL's function loses even the first TD error.
        return reward + gamma * next_value * ~terminated - value
    flags = done.expand_as(reward), terminated.expand_as(reward)
    return vec_generalized_advantage_estimate(gamma, lmbda, value, next_value, reward, *flags)[0]


def normalise_advantages(
    tensordict: TensorDictBase,
    *,
    advantage: NestedKey = "advantage",
    cost_advantage: NestedKey = "cost_advantage",
) -> TensorDictBase:
    """Standardise the reward advantage and centre the cost advantages, in place.

    Cost advantages are never rescaled. A multiplier depends on their size relative to the
    standardised reward advantage, and in CPO they must have the units of the constraint. Padding,
    by the mask of TorchRL's collectors, is ignored. The batch, which is returned, has any shape;
    advantages are [..., 1] of the reward, and [..., k] of costs, if there are any.
    """
    mask = sample_mask(tensordict)
    samples = ... if mask is None else mask
    reward, costs = require(tensordict, advantage), tensordict.get(cost_advantage, None)
    centred, scaled = reward[samples] - reward[samples].mean(), torch.zeros_like(reward)
    # what is left of a constant is rounding, which is relative to its size
    rounding = (1e-6 * reward[samples].abs().max()).clamp_min(1e-8)
    scaled[samples] = centred / torch.maximum(centred.square().mean().sqrt(), rounding)
    tensordict.set(advantage, scaled)
    if costs is not None:
        shifted = torch.zeros_like(costs)
        shifted[samples] = costs[samples] - costs[samples].flatten(0, -2).mean(0)
        tensordict.set(cost_advantage, shifted)
    return tensordict
