"""A learning rate that follows how far the policy moves in an update."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from safe_rl.ranges import Range, Share

__all__ = ["KLAdaptiveRate"]


@dataclass(frozen=True, kw_only=True)
class KLAdaptiveRate:
    """Lower the rate if the KL limit ends updates early, raise it if updates fall short of it.

    An update that a limit on the KL divergence ends after a few of its steps has followed the
    gradient of a few minibatches; at a lower rate it averages over all of them. With large
    multipliers, whose cost gradients are noisy, that decides whether a cost limit is held. The
    idea is the adaptive penalty of PPO (Schulman et al. 2017, section 4), applied to the rate.

    Attributes:
        factor: Factor by which the rate is divided or multiplied.
        lowest: Lower bound of the rate.
        highest: Upper bound of the rate.
        few_steps: Share of the planned steps below which an update has ended early.
        low_kl: Share of the KL limit below which a whole update has fallen short.

    Raises:
        ValueError: if the factor is not above 1 or the bounds are not positive and in order.

    Examples:
        >>> adapt = KLAdaptiveRate(
        ...     factor=2.0, lowest=1e-5, highest=1e-3, few_steps=0.5, low_kl=0.5
        ... )
        >>> adapt(4e-4, share_of_steps=0.2, share_of_kl=1.1)
        0.0002
        >>> adapt(4e-4, share_of_steps=1.0, share_of_kl=0.3)
        0.0008
    """

    factor: Annotated[float, Range(1, above=True)]
    lowest: Annotated[float, Range(0, 1000, above=True)]
    highest: Annotated[float, Range(0, 1000, above=True)]
    few_steps: Share
    low_kl: Share

    def __post_init__(self) -> None:
        if not self.factor > 1 or not 0 < self.lowest <= self.highest:
            raise ValueError(
                "KLAdaptiveRate needs factor > 1 and 0 < lowest <= highest, got "
                f"factor={self.factor}, lowest={self.lowest}, highest={self.highest}."
            )

    def __call__(self, rate: float, *, share_of_steps: float, share_of_kl: float) -> float:
        """Return the rate of the next update.

        Args:
            rate: rate of this update.
            share_of_steps: steps taken over steps planned.
            share_of_kl: last KL divergence over its limit.
        """
        if share_of_steps < self.few_steps:
            rate = rate / self.factor
        elif share_of_steps >= 1 and share_of_kl < self.low_kl:
            rate = rate * self.factor
        return min(max(rate, self.lowest), self.highest)
