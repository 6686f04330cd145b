"""Measures of runs: scores normalised by PPO's (section 5.1 of the paper), and violations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from safe_rl.scores.benchmark import Scores

__all__ = [
    "NOISE_OF_ZERO",
    "joined",
    "longest_streak",
    "normalised_cost_rate",
    "normalised_return",
    "normalised_violation",
    "regret",
    "share_of_epochs_over",
]

SMALLEST_EXCESS = 1e-6
"""ε, keeps the normalised violation finite where the reference keeps the limit."""


def normalised_return(episode_return: ArrayLike, reference: Scores) -> np.ndarray:
    """J̄_r = J_r / J_r^E, of any shape.

    Examples:
        >>> float(normalised_return(5.0, Scores(20.0, 50.0, 0.05)))
        0.25
    """
    return np.asarray(episode_return, dtype=float) / reference.episode_return


def normalised_violation(episode_cost: ArrayLike, limit: float, reference: Scores) -> np.ndarray:
    """M̄_c = max(0, J_c − d) / max(ε, J_c^E − d), of any shape.

    Examples:
        >>> float(normalised_violation(35.0, 25.0, Scores(20.0, 65.0, 0.05)))
        0.25
    """
    excess = np.maximum(0.0, np.asarray(episode_cost, dtype=float) - limit)
    return excess / max(SMALLEST_EXCESS, reference.episode_cost - limit)


def normalised_cost_rate(cost_rate: ArrayLike, reference: Scores) -> np.ndarray:
    """ρ̄_c = ρ_c / ρ_c^E, of any shape.

    Examples:
        >>> float(normalised_cost_rate(0.025, Scores(20.0, 50.0, 0.05)))
        0.5
    """
    return np.asarray(cost_rate, dtype=float) / reference.cost_rate


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


NOISE_OF_ZERO = 0.1
"""Normalised violation up to which a slate counts as constraint-satisfying.

The paper asks for "zero (or within noise of zero)" and gives no number. In its tables what it calls
satisfying is at most 0.056, and everything else at least 0.35.
"""
