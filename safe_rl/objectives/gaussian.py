"""Closed forms of diagonal Gaussian policies."""

from __future__ import annotations

from torch import Tensor
from torch.distributions import Distribution, Normal


def normal_parameters(distribution: Distribution) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of the Normal underneath a policy's distribution.

    Independent and transformed distributions are unwrapped: KL divergences and Fisher
    information do not change under the invertible map that, for instance, a tanh-Normal adds.

    Args:
        distribution: a Normal, or any nesting of distributions with one at its base.

    Returns:
        loc and scale, both [..., n].

    Raises:
        TypeError: if there is no Normal at the base.
    """
    base = distribution
    while not isinstance(base, Normal):
        if not hasattr(base, "base_dist"):
            raise TypeError(
                f"The policy's distribution must be Gaussian, got {type(distribution).__name__}: "
                "use torchrl.modules.IndependentNormal or another distribution over a Normal."
            )
        base = base.base_dist
    return base.loc, base.scale


def gaussian_kl(loc_p: Tensor, scale_p: Tensor, loc_q: Tensor, scale_q: Tensor) -> Tensor:
    """KL(p ‖ q) of diagonal Gaussians, summed over the last dimension.

    Args:
        loc_p: mean of p, [..., n].
        scale_p: standard deviation of p, [..., n].
        loc_q: mean of q, [..., n].
        scale_q: standard deviation of q, [..., n].

    Returns:
        Divergence in nats, [...].
    """
    ratio = (scale_p / scale_q).square()
    shift = ((loc_p - loc_q) / scale_q).square()
    return 0.5 * (ratio + shift - 1 - ratio.log()).sum(-1)
