"""Heads of policies: from the outputs of a network to a distribution of actions.

`fitting_heads` says which heads are meant for which actions; `auto` takes the first of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import torch
from tensordict.nn import AddStateIndependentNormalScale, ProbabilisticTensorDictModule
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
from torchrl.envs.utils import ExplorationType
from torchrl.modules import IndependentNormal, OneHotCategorical, TanhNormal

AUTO = "auto"
Shape: TypeAlias = torch.Size | list[int] | tuple[int, ...]

# The scale of a policy is exp(log std). The floor is far below the values in use, and only prevents
# a division by zero.
_SCALE_FLOOR = 1e-6
# Logit of choices that do not exist: probability 0, with finite gradients.
_NO_CHOICE = -1e9
# Samples of a Beta distribution keep this distance from 0 and 1, where densities are 0 or infinite.
# In single precision they may be rounded to 0 and 1.
_EDGE = 1e-6


class Head(NamedTuple):
    """How the outputs of a network become a distribution of actions.

    Attributes:
        num_outputs: Of the network.
        parameters: Module from these, [..., num_outputs], to the distribution's parameters.
        keys: Names of these parameters.
        distribution: Class of the distribution, or a function that makes one.
    """

    num_outputs: int
    parameters: nn.Module
    keys: tuple[str, ...]
    distribution: Callable[..., distributions.Distribution]


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
        initial_log_std: Initial logarithm of the standard deviation of normal distributions.
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
        return ("gaussian", "tanh", "beta") if is_matrix else ()
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


def _beta(spec: TensorSpec, initial_log_std: float, device: torch.device | None) -> Head:
    low, high = _bounds(spec, device)
    make = partial(BoundedBeta, low=low, high=high)
    return Head(2 * spec.shape[-1], _Concentrations(), ("alpha", "beta"), make)


class BoundedBeta(distributions.Independent):
    """A Beta distribution in each component of an action between bounds (Chou et al. 2017).

    Its KL divergence is that of the Beta distributions, because it does not depend on the bounds.
    The concentrations ``alpha`` and ``beta`` are [..., A], the bounds [A].

    Examples:
        >>> two = torch.full((4, 1), 2.0)
        >>> BoundedBeta(two, two, low=torch.tensor([0.0]), high=torch.tensor([6.0])).mean[0]
        tensor([3.])
    """

    def __init__(self, alpha: Tensor, beta: Tensor, *, low: Tensor, high: Tensor) -> None:
        super().__init__(distributions.Beta(alpha, beta), 1)
        self._low, self._width = low, high - low

    def rsample(self, sample_shape: Shape = torch.Size()) -> Tensor:  # noqa: B008
        """Draw actions, differentiably."""
        return self._stretched(super().rsample(sample_shape))

    def sample(self, sample_shape: Shape = torch.Size()) -> Tensor:  # noqa: B008
        """Draw actions."""
        with torch.no_grad():
            return self.rsample(sample_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        """Logarithm of the density of actions [..., A], in the action's units."""
        unit = ((value - self._low) / self._width).clamp(_EDGE, 1 - _EDGE)
        return super().log_prob(unit) - self._width.log().sum(-1)

    def entropy(self) -> Tensor:
        """Entropy in closed form, [...]."""
        return super().entropy() + self._width.log().sum(-1)

    @property
    def mean(self) -> Tensor:
        """Mean action, [..., A]."""
        return self._stretched(self.base_dist.mean)

    @property
    def deterministic_sample(self) -> Tensor:
        """The mean, because the mode is at a bound if a concentration is 1."""
        return self.mean

    def _stretched(self, unit: Tensor) -> Tensor:
        return self._low + self._width * unit.clamp(_EDGE, 1 - _EDGE)


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


HEADS: Mapping[str, Callable[[TensorSpec, float, torch.device | None], Head]] = {
    "gaussian": lambda spec, log_std, device: gaussian_head(spec.shape[-1], log_std, device),
    "tanh": _tanh,
    "beta": _beta,
    "categorical": _categorical,
    "one_hot": lambda spec, *_: Head(spec.shape[-1], nn.Identity(), ("logits",), OneHotCategorical),
}
