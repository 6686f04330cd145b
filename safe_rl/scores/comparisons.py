"""Confidence intervals of statistics, and comparisons of samples of scores.

They follow Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice"
(2021), with SciPy's bootstrap.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts are loaded on first use, which takes half a second
from numpy.typing import ArrayLike

__all__ = [
    "LEVEL",
    "Estimate",
    "bootstrap",
    "cvar",
    "interquartile_mean",
    "mean",
    "pareto_front",
    "share_over",
    "t_interval",
]


def pareto_front(returns: ArrayLike, costs: ArrayLike) -> np.ndarray:
    """Pareto-optimal agents: no other has as much return for less cost, or more for as much cost.

    Args:
        returns: Return of every agent, shape [n].
        costs: Cost of every agent, shape [n].

    Returns:
        Indices of these agents, by ascending cost.

    Examples:
        >>> pareto_front([1.0, 2.0, 3.0, 2.5], [10.0, 40.0, 30.0, 20.0]).tolist()
        [0, 3, 2]
    """
    returns, costs = np.asarray(returns, dtype=float), np.asarray(costs, dtype=float)
    order = np.lexsort((-returns, costs))
    best = np.fmax.accumulate(np.concatenate([[-np.inf], returns[order]]))[:-1]
    return order[returns[order] > best]


LEVEL = 0.95
"""Confidence level of all intervals."""
NUM_RESAMPLES = 2000
"""Number of bootstrap resamples: with it, interval ends vary by about 1/50 of the width."""
# resamples are drawn in portions of about this many numbers
_PORTION = 2_000_000


class Estimate(NamedTuple):
    """An estimate and the interval in which the estimated quantity lies with confidence 95 %.

    Examples:
        >>> print(Estimate(12.3456, 11.0, 14.0))
        12.35 [11, 14]
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        """The estimate and its interval, to four digits."""
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"


def bootstrap(
    samples: Sequence[np.ndarray], statistic: Callable[..., Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Percentile bootstrap interval, each sample being resampled on its own (stratified).

    The same samples give the same interval.

    Args:
        samples: Strata, each of shape [..., n_i] with the observations along the last axis.
        statistic: Vectorised function ``statistic(*samples, axis)``.

    Returns:
        Lower and upper ends, of the shape of the statistic; NaN if a stratum has a single
        observation, which says nothing about the spread, or if an observation is not finite.

    Examples:
        >>> low, high = bootstrap([np.arange(100.0)], np.mean)
        >>> bool(43 < low < 46), bool(53 < high < 56)
        (True, True)
    """
    samples = [np.asarray(sample, dtype=float) for sample in samples]
    are_known = all(np.isfinite(sample).all() for sample in samples)
    if min(sample.shape[-1] for sample in samples) < 2 or not are_known:
        shape = np.shape(statistic(*samples, axis=-1))
        return np.full(shape, math.nan), np.full(shape, math.nan)
    result = scipy.stats.bootstrap(
        samples,
        statistic,
        n_resamples=NUM_RESAMPLES,
        batch=max(1, _PORTION // sum(sample.size for sample in samples)),
        axis=-1,
        vectorized=True,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return result.confidence_interval.low, result.confidence_interval.high


def t_interval(values: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Student's interval of the mean over the last axis, such as seeds; for few values.

    Args:
        values: Independent values, [..., n].

    Returns:
        Lower and upper ends, [...]; NaN for a single value, which says nothing about the spread.

    Examples:
        >>> low, high = t_interval([1.0, 2.0, 3.0])
        >>> float(low.round(2)), float(high.round(2))
        (-0.48, 4.48)
    """
    values = np.asarray(values, dtype=float)
    number, centre = values.shape[-1], values.mean(-1)
    if number < 2:
        return np.full_like(centre, math.nan), np.full_like(centre, math.nan)
    quantile = scipy.stats.t.ppf((1 + LEVEL) / 2, number - 1)
    reach = quantile * values.std(-1, ddof=1) / math.sqrt(number)
    return centre - reach, centre + reach


def mean(values: ArrayLike) -> Estimate:
    """Mean of independent values, shape [n]."""
    return _estimate([values], np.mean)


def interquartile_mean(strata: Sequence[ArrayLike]) -> Estimate:
    """Mean of the middle half of all values, with an interval from a stratified bootstrap.

    Args:
        strata: Values per stratum, for example one list of scores per environment.

    Examples:
        >>> interquartile_mean([[0.0, 1.0], [2.0, 99.0]]).value
        1.5
    """

    def trimmed_mean(*samples: np.ndarray, axis: int) -> np.ndarray:
        return scipy.stats.trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)

    return _estimate(strata, trimmed_mean)


def _estimate(strata: Sequence[ArrayLike], statistic: Callable[..., Any]) -> Estimate:
    """A statistic of strata [n_i] and its bootstrap interval."""
    samples = [np.asarray(stratum, dtype=float) for stratum in strata]
    low, high = bootstrap(samples, statistic)
    return Estimate(float(statistic(*samples, axis=-1)), float(low), float(high))


def cvar(values: ArrayLike, alpha: float) -> Estimate:
    """Conditional value at risk: the mean of the largest share ``alpha`` of values, shape [n].

    If ``alpha`` n is no whole number, one value counts in part (Rockafellar, Uryasev 2000).

    Raises:
        ValueError: If ``alpha`` is not in (0, 1].

    Examples:
        >>> cvar([1.0, 2.0, 3.0, 4.0], alpha=0.5).value
        3.5
    """
    if not 0.0 < alpha <= 1.0:
        raise ValueError(f"alpha={alpha} must be a share of episodes, in (0, 1].")
    sample = np.asarray(values, dtype=float)
    number = len(sample)
    size = alpha * number

    def tail_mean(resampled: np.ndarray, axis: int) -> np.ndarray:
        largest = -np.sort(-resampled, axis=axis)
        weights = np.clip(size - np.arange(number), 0.0, 1.0)
        return (largest * weights).sum(axis) / size

    return _estimate([sample], tail_mean)


def share_over(values: ArrayLike, limit: float) -> Estimate:
    """Share of values above a limit or NaN, with Wilson's interval of a proportion."""
    values = np.asarray(values, dtype=float)
    over = int((~(values <= limit)).sum())
    interval = scipy.stats.binomtest(over, len(values)).proportion_ci(LEVEL, method="wilson")
    return Estimate(over / len(values), float(interval.low), float(interval.high))
