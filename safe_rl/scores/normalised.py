"""Scores as shares of unconstrained PPO's on the same environment (section 5.1 of the paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from safe_rl.scores.published import Scores

__all__ = ["normalised_cost_rate", "normalised_return", "normalised_violation"]

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
