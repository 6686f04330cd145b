"""What losses share: reading a batch, and the tensors of their networks."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from functools import partial
from typing import Any, Self

import torch
from tensordict import NestedKey, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS, LossModule

from safe_rl.naming import key_name, nearest


def require(tensordict: TensorDictBase, key: NestedKey, hint: str = "") -> Tensor:
    """Get an entry; the `hint` in the error says what writes it.

    Raises:
        KeyError: If there is no such entry; the message names the nearest key present.
    """
    value = tensordict.get(key, None)
    if value is not None:
        return value
    present = {key_name(entry): entry for entry in tensordict.keys(True, True)}
    near = nearest(key_name(unravel_key(key)), present)
    meant = "" if near is None else f" Did you mean {present[near]!r}?"
    raise KeyError(f"No entry {key!r} in the batch.{meant} Keys: {sorted(present)}. {hint}".strip())


def inputs_of(network: TensorDictModuleBase, batch: TensorDictBase) -> TensorDictBase:
    """A copy of the inputs of a network, into which the network may write, also below an input."""
    return batch.select(*network.in_keys).copy()


FIRST = "is_init"


def sample_mask(tensordict: TensorDictBase, loss: Any = None) -> Tensor | None:
    """Bool mask of the entries of a batch that are samples, not padding; None without padding.

    Trajectories of different lengths in one batch are padded. The mask is the one of TorchRL's
    collectors (``split_trajs=True``) and value estimators, which TorchRL's losses use too, or what
    the ``loss_mask_key`` of a loss names.
    """
    masks = [tensordict.get(key, None) for key in mask_keys(loss)]
    present = [mask.reshape(tensordict.batch_size) for mask in masks if mask is not None]
    return torch.stack(present).all(0) if present else None


def mask_keys(loss: Any = None) -> tuple[NestedKey, ...]:
    """Keys of the masks that a loss applies; TorchRL's if it is not a `LossModule`."""
    return loss._loss_mask_keys() if isinstance(loss, LossModule) else AUTO_LOSS_MASK_KEYS


def learning_samples(
    batch: TensorDictBase, in_keys: Iterable[NestedKey], loss: Any
) -> TensorDictBase:
    """Samples [B] of a loss for a policy with these inputs, or sequences [N, T] if it is recurrent.

    Padding is left out of samples. Sequences stay whole and in order. A recurrent policy reads
    `is_init`, which marks the first steps of episodes.

    Raises:
        ValueError: If sequences are padded.
        FloatingPointError: If an entry that the loss lists as an input is NaN or infinite; the
            message names it and how many samples.
    """
    mask = sample_mask(batch, loss)
    if FIRST not in in_keys:
        batch = batch.reshape(-1)
        batch = batch if mask is None else batch[mask.reshape(-1)]
    elif mask is not None or batch.ndim != 2:
        raise ValueError(
            "A recurrent policy learns from whole sequences [N, T] as collectors make them, "
            "without padding: leave split_trajs at False."
        )
    read = batch.select(*getattr(loss, "in_keys", ()), strict=False)
    for key, entry in read.items(True, True):
        # A finite sum has only finite terms, and is much faster than a check of each term.
        if not entry.is_floating_point() or entry.is_meta or entry.sum().isfinite():
            continue
        wrong = ~entry.reshape(*batch.batch_size, -1).isfinite().all(-1)
        if wrong.any():
            raise FloatingPointError(
                f"{key!r} is not finite in {int(wrong.sum())} of {wrong.numel()} samples. Nothing "
                "has been learned from this batch: look for the environment's first NaN or "
                "infinity, or lower the learning rate or the target KL if training has diverged."
            )
    return batch


class SharesTensors(LossModule):
    """Base of losses that share their tensors with their networks, also after a copy or a move.

    A loss of TorchRL stores the parameters and buffers of its networks separately. When it is
    built, loss and networks share them. After ``copy.deepcopy`` they do not: training the copy
    would not change its networks, and an optimiser copied with it would not change either. After a
    move, the networks would have their old buffers.
    """

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        for module in self.children():
            if isinstance(module, TensorDictParams):  # by itself it ignores what is copied already
                tensors = module.apply(partial(copy.deepcopy, memo=memo), filter_empty=False)
                memo[id(module)] = TensorDictParams(tensors, no_convert=True)
        new = memo[id(self)] = type(self).__new__(type(self))
        new.__setstate__(copy.deepcopy(self.__dict__, memo))
        return new

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        moved = super()._apply(*args, **kwargs)
        self._share_tensors()
        return moved

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._share_tensors()

    def _share_tensors(self) -> None:
        for name, params in self._modules.items():
            network = self.__dict__.get(name.removesuffix("_params"))
            if isinstance(network, nn.Module):
                params.to_module(network)
