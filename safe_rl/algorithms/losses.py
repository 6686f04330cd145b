"""Outputs and state of loss modules, as updates use them.

In TorchRL all entries named ``loss_…`` are minimised; others are diagnostics.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from itertools import chain
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import LossModule

from safe_rl.checks import SettingError

ESTIMATOR = "_value_estimator."
"""Prefix of buffers of value estimators: settings that a resumed run may change."""

_PREFIX = "loss_"


def sum_of_losses(losses: TensorDictBase) -> Tensor:
    """Sum of the entries that are named ``loss_…``, a scalar.

    Raises:
        ValueError: If there is none, or one of them is not a single number.
    """
    if not isinstance(losses, TensorDictBase):
        raise ValueError(
            f"A loss must return a TensorDict with entries named 'loss_…', got {type(losses)}."
        )
    terms = {name: value for name, value in losses.items() if name.startswith(_PREFIX)}
    if not terms:
        raise ValueError(
            "A loss must return an entry named 'loss_…': the sum of these entries is minimised. "
            f"It returned {sorted(losses.keys())}."
        )
    for name, value in terms.items():
        if value.numel() != 1:
            raise ValueError(
                f"{name!r} has shape {list(value.shape)}, and what is minimised is one number: "
                "let the loss return the mean over its samples."
            )
    return torch.stack([value.reshape(()) for value in terms.values()]).sum()


def finite_sum(losses: TensorDictBase) -> Tensor:
    """`sum_of_losses` of a step that is not taken if it is not finite: `divergence`."""
    if not (total := sum_of_losses(losses)).isfinite():
        raise divergence(losses)
    return total


def divergence(
    losses: TensorDictBase, outcome: str = "This step is not taken."
) -> FloatingPointError:
    """Make the error for losses whose sum is not finite: it names them, and says what to do."""
    wrong = [
        f"{name!r} is {value.item()}"
        for name, value in losses.items()
        if name.startswith(_PREFIX) and not value.isfinite()
    ]
    return FloatingPointError(
        f"{' and '.join(wrong) or 'The sum of the losses is not finite'}: training has diverged. "
        f"{outcome} Lower the learning rate, or look for a policy that has collapsed."
    )


_ESTIMATES = ("advantage", "value_target", "value")
"""Names of keys that TorchRL's losses read if present, and do not list in `in_keys`.

Without them the losses would estimate advantages themselves, from shuffled samples.
"""


def estimates_read(loss: nn.Module) -> list[NestedKey]:
    """Keys of advantages, value targets and values that a loss reads; empty without advantages."""
    if not isinstance(loss, LossModule):
        return []
    keys = {key.name: getattr(loss.tensor_keys, key.name) for key in fields(loss.tensor_keys)}
    return [keys[name] for name in _ESTIMATES if name in keys] if "advantage" in keys else []


def reported_kl(losses: TensorDictBase) -> Tensor:
    """The KL divergence that the loss reports, for early stopping.

    Raises:
        SettingError: If it reports none, or more than one number.
    """
    kl = losses.get("kl", None)
    if kl is None or kl.numel() != 1:
        raise SettingError(
            "max_kl ends an update by the scalar 'kl' that its loss reports, and this one reports "
            f"{'none' if kl is None else f'one of shape {list(kl.shape)}'}: use max_kl=null and "
            "adapt_rate=null."
        )
    return kl


class LossState:
    """Buffers and parameters of losses that belong to no network and no multiplier.

    Coefficients that TorchRL schedules (``register_coeff_buffer``) and those of its value
    estimators are left out: they are settings, which a resumed run may change.

    Args:
        losses: Losses by name, see `PolicyUpdate.loss_modules`.
        saved_elsewhere: Modules that checkpoints save themselves; losses share their tensors.
    """

    def __init__(
        self, losses: Mapping[str, nn.Module], saved_elsewhere: Iterable[nn.Module]
    ) -> None:
        self._losses = dict(losses)
        self._saved_elsewhere = list(saved_elsewhere)

    def state_dict(self) -> dict[str, Tensor]:
        """Copies, by the name of the loss and the tensor's name in it."""
        return {name: tensor.detach().clone() for name, tensor in self.tensors.items()}

    @torch.no_grad()
    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Load a `state_dict` in place, because an optimiser has the same tensors."""
        for name, tensor in self.tensors.items():
            tensor.copy_(state_dict[name])

    @property
    def tensors(self) -> dict[str, Tensor]:
        """The tensors themselves; a loss may replace a buffer, so ask at every use."""
        modules = self._saved_elsewhere
        known = {x.data_ptr() for part in modules for x in chain(part.parameters(), part.buffers())}
        return {
            f"{place}.{name}": tensor
            for place, loss in self._losses.items()
            for name, tensor in chain(loss.named_parameters(), loss.named_buffers())
            if tensor.data_ptr() not in known and not _is_setting(name, loss)
        }


def _is_setting(name: str, loss: nn.Module) -> bool:
    """Whether a tensor is a schedulable coefficient of the loss or belongs to a value estimator."""
    declared = (vars(kind).get("_schedulable_buffers", ()) for kind in type(loss).__mro__)
    return name.startswith(ESTIMATOR) or name in chain.from_iterable(declared)
