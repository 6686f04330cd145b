"""Distributions of actions that neither torch nor TorchRL provides."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import torch
from tensordict.nn import ProbabilisticTensorDictModule
from torch import Tensor
from torch.distributions import Beta, Categorical, Distribution, Independent
from torch.nn.functional import softplus
from torchrl.envs.utils import ExplorationType
from torchrl.modules import TanhNormal

__all__ = ["BoundedBeta", "SquashedNormal", "action_sampler", "choices"]

# Single precision rounds to 0 and 1, where Beta densities are zero or infinite.
_EDGE = 1e-6
Shape: TypeAlias = torch.Size | list[int] | tuple[int, ...]


def action_sampler(
    parameters: Sequence[str], distribution: Callable[..., Distribution], **settings: Any
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


def choices(logits: Tensor) -> Independent:
    """Return a distribution of independent choices, one for each of A components of an action.

    Args:
        logits: [..., A, C]; components with fewer than C choices end with very low logits.

    Examples:
        >>> choices(torch.zeros(5, 2, 3)).log_prob(torch.zeros(5, 2)).exp()[0]
        tensor(0.1111)
    """
    return Independent(Categorical(logits=logits), 1)


class BoundedBeta(Independent):
    """A Beta distribution in each component of an action between bounds (Chou et al. 2017).

    Its KL divergence is that of the Beta distributions, because it does not depend on the bounds.

    Args:
        alpha: First concentrations, [..., A].
        beta: Second concentrations, [..., A].
        low: Lower bounds, [A].
        high: Upper bounds, [A].

    Examples:
        >>> import torch
        >>> two = torch.full((4, 1), 2.0)
        >>> BoundedBeta(two, two, low=torch.tensor([0.0]), high=torch.tensor([6.0])).mean[0]
        tensor([3.])
    """

    def __init__(self, alpha: Tensor, beta: Tensor, *, low: Tensor, high: Tensor) -> None:
        super().__init__(Beta(alpha, beta), 1)
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


class SquashedNormal(TanhNormal):
    """A `TanhNormal` that is built when a method other than `rsample_and_log_prob` is called.

    Soft actor-critics only call this method, twice per update. Building the transforms and checking
    the bounds takes six times as long.

    Args:
        loc: Means before the tanh, [..., A].
        scale: Standard deviations, [..., A].
        low: Lower bounds, [A].
        high: Upper bounds, [A].

    Examples:
        >>> bounds = torch.tensor([-1.0]), torch.tensor([3.0])
        >>> policy = SquashedNormal(torch.zeros(5, 1), torch.ones(5, 1), *bounds)
        >>> action, log_prob = policy.rsample_and_log_prob()
        >>> torch.allclose(log_prob, policy.log_prob(action), atol=1e-4)
        True
    """

    def __init__(self, loc: Tensor, scale: Tensor, low: Tensor, high: Tensor) -> None:
        self.__dict__["_given"] = {"loc": loc, "scale": scale, "low": low, "high": high}

    def __getattr__(self, name: str) -> Any:
        given = self.__dict__.get("_given")
        if given is None or "_t" in self.__dict__ or name.startswith("__"):
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")
        super().__init__(**given)
        return getattr(self, name)

    def rsample_and_log_prob(self, sample_shape: Shape = torch.Size()) -> tuple[Tensor, Tensor]:  # noqa: B008
        """Draw actions [..., A], differentiably, and compute their log-densities [...]."""
        loc, scale, low, high = self.__dict__["_given"].values()
        noise = torch.randn(*sample_shape, *loc.shape, dtype=loc.dtype, device=loc.device)
        inner, half = torch.addcmul(loc, scale, noise), (high - low) / 2
        # log of the tanh's slope, without its rounding where it is flat
        slope = 2 * (math.log(2) - inner - softplus(-2 * inner))
        density = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2 * math.pi)
        log_prob = (density - slope - half.log()).sum(-1)
        return low + half * (1 + inner.tanh()), log_prob
