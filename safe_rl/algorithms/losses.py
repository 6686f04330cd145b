"""What a loss module returns, as updates take it: the sum that is minimised, or why there is none.

TorchRL means all entries that are named ``loss_…`` to be minimised; others are diagnostics.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = ["ESTIMATOR", "divergence", "sum_of_losses"]

ESTIMATOR = "_value_estimator."
"""Where losses keep numbers of their value estimators, which a run that is resumed may change."""

_PREFIX = "loss_"


def sum_of_losses(losses: TensorDictBase) -> Tensor:
    """Sum of the entries that are named ``loss_…``, a scalar.

    Raises:
        ValueError: If one of them is not a single number.

    Examples:
        >>> from tensordict import TensorDict
        >>> losses = TensorDict(loss_actor=torch.tensor(1.0), loss_alpha=torch.tensor(2.0))
        >>> sum_of_losses(losses.set("entropy", torch.tensor(5.0)))
        tensor(3.)
    """
    terms = {name: value for name, value in losses.items() if name.startswith(_PREFIX)}
    for name, value in terms.items():
        if value.numel() != 1:
            raise ValueError(
                f"{name!r} has shape {list(value.shape)}, and what is minimised is one number: "
                "let the loss return the mean over its samples."
            )
    return torch.stack([value.reshape(()) for value in terms.values()]).sum()


def divergence(losses: TensorDictBase) -> FloatingPointError:
    """The error for losses whose sum is not finite: which of them are not, and what to do.

    Examples:
        >>> from tensordict import TensorDict
        >>> losses = TensorDict(loss_actor=torch.tensor(torch.nan), loss_alpha=torch.tensor(2.0))
        >>> str(divergence(losses)).partition(".")[0]
        "'loss_actor' is nan: training has diverged"
    """
    wrong = [
        f"{name!r} is {value.item()}"
        for name, value in losses.items()
        if name.startswith(_PREFIX) and not value.isfinite()
    ]
    return FloatingPointError(
        f"{' and '.join(wrong) or 'The sum of the losses is not finite'}: training has diverged. "
        "The step that would follow is not taken. Lower the learning rate, or look for a policy "
        "that has collapsed."
    )
