"""Upper confidence bounds of means by betting, and statements about means."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import ROUND_CEILING, Context

import numpy as np
from numpy.typing import ArrayLike

# bets, as shares of the largest possible one, and the share of the first wealth for each. An
# episode's highest cost is usually far above the limit, and then large bets are the best ones
_BETS = np.array([0.99, 0.7, 0.4, 0.2, 0.08, 0.03])
_WEIGHTS = np.array([4, 2, 1, 1, 1, 1]) / 10
_MOST_EPISODES = 2**22  # of a test whose number of episodes is sought


def rounded_up(bound: float, digits: int = 3) -> float:
    """An upper bound with fewer significant digits, which is shown no lower than it is.

    Examples:
        >>> [f"{rounded_up(bound):.3g}" for bound in (25.04, 25.1, 0.01234)]
        ['25.1', '25.1', '0.0124']
    """
    return float(Context(digits, ROUND_CEILING).create_decimal(repr(float(bound))))


def _growth(values: ArrayLike, mean: float, highest: float) -> np.ndarray:
    """Log of the wealth from each of the six bets, starting at 1, after every value [n]: [6, n]."""
    values = np.asarray(values, dtype=float)
    gains = (mean - values) / (highest - mean)
    # a value above the highest would make a negative wealth: it ends the bet
    return np.log1p((_BETS[:, np.newaxis] * gains).clip(-1 + 1e-12)).cumsum(-1)


def log_wealth(values: ArrayLike, mean: float, highest: float) -> np.ndarray:
    """Log of the wealth after every value of a player who bets that the mean is below ``mean``.

    The player divides a wealth of 1 among bets λ. Every value multiplies the wealth of each bet by
    1 + λ (mean − value). If the values' true mean is ``mean`` or more, the expected wealth does not
    grow, and the probability that the wealth ever reaches 1/α is at most α (Ville's inequality;
    Waudby-Smith and Ramdas 2024, section 4).

    Args:
        values: Independent values from 0 to ``highest``, in the order of their draws, [n].
        mean: The hypothetical mean, below ``highest``.
        highest: The largest possible value.

    Returns:
        Log of the total wealth, [n].

    Examples:
        >>> log_wealth([0.0] * 4, mean=0.5, highest=1.0).round(2).tolist()
        [0.47, 1.0, 1.57, 2.17]
    """
    logs = _growth(values, mean, highest) + np.log(_WEIGHTS)[:, np.newaxis]
    wealth: np.ndarray = np.logaddexp.reduce(logs, axis=0)
    return wealth


def betting_bound(values: ArrayLike, level: float, highest: float) -> float:
    """Upper confidence bound of the mean of values in [0, ``highest``], for any distribution.

    It is the largest mean that `log_wealth` does not exclude. The bounds after 1, 2, … values
    hold simultaneously: one may stop as soon as a bound is low enough.

    Args:
        values: Independent values, [n].
        level: Confidence, in (0.5, 1).
        highest: The largest possible value; finite.

    Returns:
        The bound; infinite if a value is NaN, infinite or above ``highest``.

    Raises:
        ValueError: If all values are finite, but ``highest`` is not.

    Examples:
        >>> round(betting_bound([20.0, 22.0, 24.0, 26.0] * 50, level=0.95, highest=50.0), 2)
        23.59
        >>> round(betting_bound([0.0] * 59, level=0.95, highest=100.0), 1)
        6.1
    """
    values = np.asarray(values, dtype=float)
    if not np.isfinite(values).all() or (values > highest * (1 + 1e-6)).any():
        return math.inf
    if not math.isfinite(highest):
        raise ValueError(f"The highest value must be finite, not {highest}.")
    if not values.size or highest <= 0:
        return float(highest)
    low, high = float(values.mean()), float(highest)
    while high - low > 1e-9 * highest:
        middle = (low + high) / 2
        excluded = log_wealth(values, middle, highest)[-1] >= -math.log(1 - level)
        low, high = (low, middle) if excluded else (middle, high)
    return high


@dataclass(frozen=True)
class Statement:
    """The statement that a mean over episodes, such as that of the cost, is at most a limit."""

    name: str  # of the mean
    limit: float
    highest: float  # the largest possible value
    values: np.ndarray  # of every episode, [E]

    @property
    def is_by_construction(self) -> bool:
        """Whether no value can exceed the limit, so that no episode has to show it."""
        return self.highest <= self.limit

    def fewest(self, level: float) -> float:
        """Number of episodes after which betting shows it if all values are the lowest of these.

        It is infinite if that value is not below the limit.
        """
        if self.is_by_construction:
            return 1
        lowest, needed, number = float(self.values.min()), -math.log(1 - level), 1
        while lowest < self.limit and number < _MOST_EPISODES:
            number *= 2
            is_shown = log_wealth(np.full(number, lowest), self.limit, self.highest) >= needed
            if is_shown[-1]:
                return int(np.argmax(is_shown)) + 1
        return math.inf

    def bound(self, level: float) -> float:
        """Upper confidence bound of the mean."""
        return betting_bound(self.values, level, self.highest)

    def is_shown(self, level: float) -> bool:
        """Whether the bound is within the limit, without computing it."""
        if self.is_by_construction or not np.isfinite(self.values).all():
            return self.bound(level) <= self.limit
        return bool(log_wealth(self.values, self.limit, self.highest)[-1] >= -math.log(1 - level))

    def is_hopeless(self, level: float, most: int) -> bool:
        """Whether the test will probably fail with this total number of episodes.

        This is the case if the log wealth of the best bet is less than a quarter of what it needs,
        in proportion to the episodes so far. This does not make a wrong certificate more likely,
        because a test may be given up at any time.
        """
        if self.is_by_construction:
            return False
        needed = -math.log(1 - level) * len(self.values) / most
        best = _growth(self.values, self.limit, self.highest)[:, -1].max()
        return bool(best < needed / 4)
