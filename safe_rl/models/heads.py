"""Heads of policies: from the outputs of a network to a distribution of actions.

Every row of `HEADS` says for which actions its head is meant; `auto` takes the first that fits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import torch
from tensordict.nn import AddStateIndependentNormalScale
from torch import Tensor, distributions, nn
from torch.nn.functional import pad, softplus
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
)
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal

from safe_rl.models.action_distributions import BoundedBeta, choices

__all__ = ["AUTO", "HEADS", "Head", "gaussian_head", "make_head"]

AUTO = "auto"

# The scale of a policy is exp(log std). The floor is far below the values in use, and only prevents
# a division by zero.
_SCALE_FLOOR = 1e-6
# Logit of choices that do not exist: probability 0, with finite gradients.
_NO_CHOICE = -1e9


class Head(NamedTuple):
    """How the outputs of a network become a distribution of actions.

    Attributes:
        num_outputs: Number of outputs of the network.
        parameters: Module from these, [..., num_outputs], to the distribution's parameters.
        keys: Names of these parameters.
        distribution: Class of the distribution, or a function that makes one.
    """

    num_outputs: int
    parameters: nn.Module
    keys: tuple[str, ...]
    distribution: Callable[..., distributions.Distribution]


class _Row(NamedTuple):
    """A head: the actions that it is meant for, and the function that makes it."""

    fits: Callable[[TensorSpec], bool]
    make: Callable[[TensorSpec, float, torch.device | None], Head]


def make_head(
    kind: str,
    action_spec: TensorSpec,
    *,
    initial_log_std: float,
    device: torch.device | None = None,
) -> Head:
    """Make the head for an environment's actions.

    Args:
        kind: A key of `HEADS`, or "auto".
        action_spec: Spec of the actions of N environments: [N, A] bounded, [N] or [N, A] integers,
            or [N, C] one-hot.
        initial_log_std: Initial logarithm of the standard deviation of normal distributions; other
            heads do not use it.
        device: Device of the parameters.

    Raises:
        ValueError: If the head, or every head, is for other actions.

    Examples:
        >>> from torchrl.data import Categorical
        >>> make_head("auto", Categorical(4, shape=(8,)), initial_log_std=-0.5).num_outputs
        4
    """
    fitting = [name for name, row in HEADS.items() if row.fits(action_spec)]
    if not fitting:
        raise ValueError(
            f"No policy can act in {type(action_spec).__name__}{list(action_spec.shape)}: actions "
            "are bounded numbers [N, A], choices [N] or [N, A], or one-hot [N, C]."
        )
    chosen = fitting[0] if kind == AUTO else kind
    if chosen not in fitting:
        raise ValueError(
            f"model.head={kind} is not for the actions of this environment: "
            f"{' or '.join((AUTO, *fitting))}."
        )
    return HEADS[chosen].make(action_spec, initial_log_std, device)


def gaussian_head(
    action_size: int, initial_log_std: float, device: torch.device | None = None
) -> Head:
    """A diagonal Gaussian with a state-independent scale; the environment clips its actions."""
    scale = AddStateIndependentNormalScale(
        action_size, init_value=initial_log_std, scale_lb=_SCALE_FLOOR, device=device
    )
    return Head(action_size, scale, ("loc", "scale"), IndependentNormal)


def _gaussian(spec: TensorSpec, initial_log_std: float, device: torch.device | None) -> Head:
    return gaussian_head(spec.shape[-1], initial_log_std, device)


def _tanh(spec: TensorSpec, initial_log_std: float, device: torch.device | None) -> Head:
    """A Gaussian squashed into the bounds; its scale is that before squashing."""
    low, high = _bounds(spec, device)
    head = gaussian_head(spec.shape[-1], initial_log_std, device)
    return head._replace(distribution=partial(TanhNormal, low=low, high=high))


def _beta(spec: TensorSpec, initial_log_std: float, device: torch.device | None) -> Head:
    low, high = _bounds(spec, device)
    make = partial(BoundedBeta, low=low, high=high)
    return Head(2 * spec.shape[-1], _Concentrations(), ("alpha", "beta"), make)


def _categorical(spec: TensorSpec, initial_log_std: float, device: torch.device | None) -> Head:
    """One logit per choice; an action of shape [N] has no dimension of components."""
    numbers = _num_choices(spec)
    if len(spec.shape) == 1:
        return Head(numbers[0], nn.Identity(), ("logits",), distributions.Categorical)
    return Head(sum(numbers), _Components(numbers), ("logits",), choices)


def _one_hot(spec: TensorSpec, initial_log_std: float, device: torch.device | None) -> Head:
    return Head(spec.shape[-1], nn.Identity(), ("logits",), OneHotCategorical)


class _Concentrations(nn.Module):
    """Two concentrations above 1 per component: densities are unimodal (Chou et al. 2017)."""

    def forward(self, outputs: Tensor) -> tuple[Tensor, Tensor]:
        alpha, beta = (1 + softplus(outputs)).chunk(2, -1)
        return alpha, beta


class _Components(nn.Module):
    """Reshapes concatenated logits to [..., A, C], with C the largest number of choices."""

    def __init__(self, choices: list[int]) -> None:
        super().__init__()
        self._choices = choices

    def forward(self, outputs: Tensor) -> Tensor:
        most = max(self._choices)
        parts = outputs.split(self._choices, -1)
        padded = [pad(part, (0, most - part.shape[-1]), value=_NO_CHOICE) for part in parts]
        return torch.stack(padded, -2)


def _bounds(spec: TensorSpec, device: torch.device | None) -> tuple[Tensor, Tensor]:
    """Bounds of one environment's actions, [A] each."""
    size, space = spec.shape[-1], spec.space
    return space.low.reshape(-1, size)[0].to(device), space.high.reshape(-1, size)[0].to(device)


def _num_choices(spec: TensorSpec) -> list[int]:
    """Number of choices of every component of one environment's action."""
    size = spec.shape[-1] if len(spec.shape) > 1 else 1
    if isinstance(spec, MultiCategorical):
        return spec.nvec.reshape(-1, size)[0].tolist()
    if isinstance(spec, Categorical):
        return [int(spec.space.n)] * size
    return [highest + 1 for highest in spec.space.high.reshape(-1, size)[0].tolist()]


def _is_continuous(spec: TensorSpec) -> bool:
    return isinstance(spec, Bounded) and spec.dtype.is_floating_point and len(spec.shape) == 2


def _is_choice(spec: TensorSpec) -> bool:
    if len(spec.shape) > 2:
        return False
    if isinstance(spec, Bounded) and not spec.dtype.is_floating_point:
        return not spec.space.low.any()  # Gymnasium's MultiDiscrete of several environments
    return isinstance(spec, Categorical) and not isinstance(spec, Binary)


def _is_one_hot(spec: TensorSpec) -> bool:
    return isinstance(spec, OneHot) and not isinstance(spec, MultiOneHot) and len(spec.shape) == 2


HEADS: Mapping[str, _Row] = {
    "gaussian": _Row(_is_continuous, _gaussian),
    "tanh": _Row(_is_continuous, _tanh),
    "beta": _Row(_is_continuous, _beta),
    "categorical": _Row(_is_choice, _categorical),
    "one_hot": _Row(_is_one_hot, _one_hot),
}
