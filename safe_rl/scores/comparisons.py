"""How samples of scores compare as wholes: more than one number each.

As in Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021),
with SciPy's bootstrap.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from safe_rl.scores.intervals import Estimate, bootstrap

__all__ = ["pareto_front", "performance_profile", "probability_of_improvement"]


def probability_of_improvement(first: Sequence[ArrayLike], second: Sequence[ArrayLike]) -> Estimate:
    """How likely a run of the first algorithm scores higher than one of the second.

    Ties count half. Probabilities are those of single environments, averaged; the bootstrap of the
    interval resamples the runs of either algorithm on every environment on their own.

    Args:
        first: Scores per environment, one list of runs each.
        second: The same of the other algorithm, environments in the same order.

    Examples:
        >>> probability_of_improvement([[1.0, 3.0]], [[2.0, 2.0]]).value
        0.5
    """
    samples = [np.asarray(stratum, dtype=float) for stratum in (*first, *second)]
    number = len(first)

    def statistic(*strata: np.ndarray, axis: int = -1) -> Any:
        pairs = zip(strata[:number], strata[number:], strict=True)
        return np.mean([_share_higher(x, y) for x, y in pairs], axis=0)

    low, high = bootstrap(samples, statistic)
    return Estimate(float(statistic(*samples)), float(low), float(high))


def _share_higher(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Share of pairs of [..., n] and [..., m] in which the first is higher, shape [...]."""
    differences = x[..., :, np.newaxis] - y[..., np.newaxis, :]
    return ((np.sign(differences) + 1) / 2).mean((-2, -1))


def performance_profile(
    strata: Sequence[ArrayLike], thresholds: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of runs that score higher than each threshold, with its interval.

    Args:
        strata: Scores per environment, one list of runs each.
        thresholds: τ, shape [t].

    Returns:
        Shares and the ends of their intervals from a stratified bootstrap, each of shape [t].

    Examples:
        >>> performance_profile([[1.0, 3.0], [5.0, 5.0]], [0.0, 2.0, 4.0])[0].tolist()
        [1.0, 0.75, 0.5]
    """
    heights = np.asarray(thresholds, dtype=float)[:, np.newaxis]
    samples = [(np.asarray(runs, dtype=float) > heights).astype(float) for runs in strata]

    def share(*parts: np.ndarray, axis: int = -1) -> np.ndarray:
        return np.concatenate(parts, axis=axis).mean(axis)

    return share(*samples), *bootstrap(samples, share)


def pareto_front(returns: ArrayLike, costs: ArrayLike) -> np.ndarray:
    """Which agents no other one beats: none has as much return for less cost, or more for as much.

    Args:
        returns: Shape [n].
        costs: Shape [n].

    Returns:
        Their numbers, by ascending cost.

    Examples:
        >>> pareto_front([1.0, 2.0, 3.0, 2.5], [10.0, 40.0, 30.0, 20.0]).tolist()
        [0, 3, 2]
    """
    returns, costs = np.asarray(returns, dtype=float), np.asarray(costs, dtype=float)
    order = np.lexsort((-returns, costs))
    best = np.maximum.accumulate(np.concatenate([[-np.inf], returns[order]]))[:-1]
    return order[returns[order] > best]
