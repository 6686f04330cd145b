"""Heads of policies: from the outputs of a network to a distribution of actions.

`fitting_heads` says which heads are meant for which actions; `auto` takes the first of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from tensordict.nn import AddStateIndependentNormalScale, ProbabilisticTensorDictModule
from torch import Tensor, distributions, nn
from torch.nn.functional import pad
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
)
from torchrl.envs.utils import ExplorationType
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal

AUTO = "auto"

# The scale of a policy is exp(log std). The floor is far below the values in use, and only prevents
# a division by zero.
_SCALE_FLOOR = 1e-6
# Logit of choices that do not exist: probability 0, with finite gradients.
_NO_CHOICE = -1e9


class Head(NamedTuple):
    """How the outputs of a network become a distribution of actions."""

    num_outputs: int  # of the network
    parameters: nn.Module  # from these, [..., num_outputs], to the distribution's parameters
    keys: tuple[str, ...]  # names of these parameters
    distribution: Callable[..., distributions.Distribution]  # a class, or a function


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
        initial_log_std: Of normal distributions.
        device: Device of the parameters.

    Raises:
        ValueError: If the head, or every head, is for other actions.
    """
    fitting = fitting_heads(action_spec)
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
    return HEADS[chosen](action_spec, initial_log_std, device)


def fitting_heads(spec: TensorSpec) -> tuple[str, ...]:
    """Return the heads for the actions of N environments, the usual one first."""
    is_matrix, is_real = len(spec.shape) == 2, spec.dtype.is_floating_point
    if isinstance(spec, Bounded) and is_real:
        return ("gaussian", "tanh") if is_matrix else ()
    if isinstance(spec, OneHot) and not isinstance(spec, MultiOneHot):
        return ("one_hot",) if is_matrix else ()
    is_choice = isinstance(spec, Categorical) and not isinstance(spec, Binary)
    if isinstance(spec, Bounded):  # Gymnasium's MultiDiscrete of several environments
        is_choice = not spec.space.low.any()
    return ("categorical",) if is_choice and len(spec.shape) <= 2 else ()


def action_sampler(
    parameters: Sequence[str],
    distribution: Callable[..., distributions.Distribution],
    **settings: Any,
) -> ProbabilisticTensorDictModule:
    """Return a module that reads parameters, and writes ``action`` and ``action_log_prob``."""
    return ProbabilisticTensorDictModule(
        in_keys=list(parameters),
        out_keys=["action"],
        distribution_class=distribution,
        distribution_kwargs=settings,
        return_log_prob=True,
        log_prob_key="action_log_prob",
        default_interaction_type=ExplorationType.RANDOM,
    )


def gaussian_head(
    action_size: int, initial_log_std: float, device: torch.device | None = None
) -> Head:
    """A diagonal Gaussian with a state-independent scale; the environment clips its actions."""
    scale = AddStateIndependentNormalScale(
        action_size, init_value=initial_log_std, scale_lb=_SCALE_FLOOR, device=device
    )
    return Head(action_size, scale, ("loc", "scale"), IndependentNormal)


def _tanh(spec: TensorSpec, initial_log_std: float, device: torch.device | None) -> Head:
    """A Gaussian squashed into the bounds; its scale is that before squashing."""
    low, high = _bounds(spec, device)
    head = gaussian_head(spec.shape[-1], initial_log_std, device)
    return head._replace(distribution=partial(TanhNormal, low=low, high=high))


def _categorical(spec: TensorSpec, initial_log_std: float, device: torch.device | None) -> Head:
    """One logit per choice; an action of shape [N] has no dimension of components."""
    numbers = _num_choices(spec)
    if len(spec.shape) == 1:
        return Head(numbers[0], nn.Identity(), ("logits",), distributions.Categorical)
    return Head(sum(numbers), _Components(numbers), ("logits",), choices)


def choices(logits: Tensor) -> distributions.Independent:
    """Independent choices, one for each of A components of an action, from logits [..., A, C].

    Components with fewer than C choices end with very low logits.
    """
    return distributions.Independent(distributions.Categorical(logits=logits), 1)


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


HEADS: Mapping[str, Callable[[TensorSpec, float, torch.device | None], Head]] = {
    "gaussian": lambda spec, log_std, device: gaussian_head(spec.shape[-1], log_std, device),
    "tanh": _tanh,
    "categorical": _categorical,
    "one_hot": lambda spec, *_: Head(spec.shape[-1], nn.Identity(), ("logits",), OneHotCategorical),
}
