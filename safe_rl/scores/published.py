"""What was published about the benchmark, read from ``published.yaml``.

Source: Ray, Achiam, Amodei (2019), sections 5.1 and 5.2, Tables 1 and 2, and later
re-implementations.
"""

from __future__ import annotations

from importlib.resources import files
from typing import Any, NamedTuple

import yaml

__all__ = [
    *("ALGORITHMS", "COST_LIMIT", "PUBLISHED", "PUBLISHED_STEPS", "REFERENCE"),
    *("REIMPLEMENTATIONS", "REIMPLEMENTATION_STEPS", "SEEDS", "Normalised", "Scores"),
]


class Scores(NamedTuple):
    """J_r, J_c and ρ_c: mean return and cost of an episode, cost per step of all training."""

    episode_return: float
    episode_cost: float
    cost_rate: float


class Normalised(NamedTuple):
    """J̄_r, M̄_c and ρ̄_c."""

    episode_return: float
    violation: float
    cost_rate: float


_DATA: dict[str, Any] = yaml.safe_load(files(__package__).joinpath("published.yaml").read_text())

ALGORITHMS: dict[str, str] = _DATA["algorithms"]
"""Algorithm -> its name in the paper, in the order of the paper's tables."""
COST_LIMIT: float = _DATA["cost_limit"]
"""d, undiscounted cost per episode."""
SEEDS: tuple[int, ...] = tuple(_DATA["seeds"])
"""Seeds of the published runs: three per environment."""

REFERENCE = {name: Scores(*entry["scores"]) for name, entry in _DATA["reference"].items()}
"""Characteristic metrics of every constrained environment: the final ones of unconstrained PPO."""
PUBLISHED_STEPS: dict[str, int] = {n: entry["steps"] for n, entry in _DATA["reference"].items()}
"""Environment steps after which the paper's values were measured."""

PUBLISHED = {
    slate: {algorithm: Normalised(*scores) for algorithm, scores in table.items()}
    for slate, table in _DATA["tables"].items()
}
"""Slate -> algorithm -> average normalised scores."""

REIMPLEMENTATIONS: dict[str, dict[str, tuple[float, float]]] = {
    environment: {algorithm: tuple(scores) for algorithm, scores in table.items()}
    for environment, table in _DATA["reimplementations"]["scores"].items()
}
"""Environment -> algorithm -> return and episode cost of later re-implementations."""
REIMPLEMENTATION_STEPS: int = _DATA["reimplementations"]["steps"]
"""Environment steps after which these were measured."""
