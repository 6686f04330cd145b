"""What learning has cost and how long it took: figures of a run's whole course, not of its end.

All take one value per epoch, shape [epochs], of epochs in which an episode finished.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["first_good_epoch", "joined", "longest_streak", "regret", "share_of_epochs_over"]


def joined(values: ArrayLike, number: int) -> np.ndarray:
    """Means of `number` consecutive epochs, of fewer at the beginning.

    The mean of few episodes is above a limit more often, so that algorithms whose epochs are
    shorter than others' would seem to break it more.

    Examples:
        >>> joined([9.0, 30.0, 20.0, 10.0, 24.0], number=2).tolist()
        [9.0, 25.0, 17.0]
    """
    known = np.asarray(values, dtype=float)
    starts = np.arange(len(known) % number or number, len(known), number)
    return np.array([part.mean() for part in np.split(known, starts) if len(part)])


def regret(costs: ArrayLike, limit: float) -> float:
    """Cost per episode above the limit, averaged over training: mean of max(0, J_c − d).

    An epoch below the limit does not make up for another one above it.

    Examples:
        >>> regret([45.0, 35.0, 5.0, 15.0], limit=25.0)
        7.5
    """
    return float(np.maximum(0.0, np.asarray(costs, dtype=float) - limit).mean())


def share_of_epochs_over(costs: ArrayLike, limit: float) -> float:
    """Share of epochs whose J_c is above the limit.

    Examples:
        >>> share_of_epochs_over([45.0, 35.0, 5.0, 25.0], limit=25.0)
        0.5
    """
    return float((np.asarray(costs, dtype=float) > limit).mean())


def longest_streak(costs: ArrayLike, limit: float) -> int:
    """Most epochs in a row whose J_c is above the limit.

    Examples:
        >>> longest_streak([30.0, 5.0, 30.0, 30.0, 5.0], limit=25.0)
        2
    """
    over = (np.asarray(costs, dtype=float) > limit).astype(int)
    edges = np.flatnonzero(np.diff(over, prepend=0, append=0))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def first_good_epoch(
    returns: ArrayLike, costs: ArrayLike, least_return: float, limit: float
) -> int | None:
    """Return the number of the first epoch with J_r ≥ x and J_c ≤ d, or None if there is none.

    Steps and time up to it are the sample and the wall-clock efficiency of a run.

    Examples:
        >>> first_good_epoch([1.0, 9.0, 8.0], [10.0, 60.0, 20.0], least_return=5.0, limit=25.0)
        2
    """
    returns, costs = np.asarray(returns, dtype=float), np.asarray(costs, dtype=float)
    found = np.flatnonzero((returns >= least_return) & (costs <= limit))
    return int(found[0]) if found.size else None
