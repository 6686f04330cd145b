"""The samples of a batch: which are padding, and whether all are finite."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS


def sample_mask(tensordict: TensorDictBase) -> Tensor | None:
    """Which entries of a batch are samples, as a bool tensor of its shape; None: all of them.

    Trajectories of different lengths in one batch are padded. The masks of the collectors
    (``split_trajs=True``) and of the value estimators, which TorchRL's losses honour, say where.
    """
    masks = [tensordict.get(key, None) for key in AUTO_LOSS_MASK_KEYS]
    present = [mask.reshape(tensordict.batch_size) for mask in masks if mask is not None]
    return torch.stack(present).all(0) if present else None


def flat_samples(batch: TensorDictBase) -> TensorDictBase:
    """The samples of a batch of any shape as a batch [B], without padding."""
    mask = sample_mask(batch)
    flat = batch.reshape(-1)
    return flat if mask is None else flat[mask.reshape(-1)]


def require_finite(tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> None:
    """Raise before anything is learnt from numbers that are not numbers.

    Args:
        tensordict: batch of any shape; padding may hold anything.
        keys: entries to check, those of floating point; missing ones are left to the reader.

    Raises:
        FloatingPointError: naming the entry and how many samples are concerned.
    """
    mask = sample_mask(tensordict)
    for key in keys:
        entry = tensordict.get(key, None)
        if entry is None or not entry.is_floating_point() or entry.is_meta:
            continue
        # A sum is finite only if all its terms are, and much cheaper than looking at each.
        if mask is None and entry.sum().isfinite():
            continue
        wrong = ~entry.reshape(*tensordict.batch_size, -1).isfinite().all(-1)
        wrong = wrong if mask is None else wrong & mask
        if wrong.any():
            raise FloatingPointError(
                f"{key!r} is not finite in {int(wrong.sum())} of {wrong.numel()} samples. Nothing "
                "has been learnt from this batch: look for the environment's first NaN or "
                "infinity, or lower the learning rate or the target KL if training has diverged."
            )
