"""The benchmark: its environments, its slates (sets of environments), and published results.

Published figures are in ``published.yaml``: Ray, Achiam, Amodei (2019), sections 5.1 and 5.2,
Tables 1 and 2, and later re-implementations.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, NamedTuple

import yaml

Node = Mapping[str, Any]


class Scores(NamedTuple):
    """J_r, J_c and ρ_c: mean return and cost of an episode, and cost per step of all training."""

    episode_return: float
    episode_cost: float
    cost_rate: float


class Normalised(NamedTuple):
    """Normalised return J̄_r, violation M̄_c and cost rate ρ̄_c; see `safe_rl.scores.measures`."""

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
"""Environment steps after which the scores of re-implementations were measured."""


@dataclass(frozen=True)
class Suite:
    """The benchmark's environments, as configurations.

    Attributes:
        environments: Name -> all keys of the environment, as in a run's configuration.
        defaults: Value of every key that a configuration leaves out.

    Examples:
        >>> suite = Suite({"PointGoal1": {"task": "goal", "size": 2}}, {"task": None, "size": 2})
        >>> suite.name_of({"name": "PointGoal1", "task": "goal"})
        'PointGoal1'
        >>> suite.name_of({"name": "PointGoal1", "id": "Pendulum-v1"}) is None
        True
        >>> suite.changes({"name": "PointGoal1", "task": "goal", "size": 3})
        {'size': 3}
    """

    environments: Mapping[str, Node]
    defaults: Node

    def changes(self, node: Node) -> dict[str, Any] | None:
        """Keys that differ from the benchmark's environment of that name; None if there is none."""
        name = node.get("name")
        standard = self.environments.get(name) if isinstance(name, str) else None
        if standard is None:
            return None
        own = {**self.defaults, **node}
        keys = dict.fromkeys([*standard, *own])
        differ = [key for key in keys if own.get(key, ...) != standard.get(key, ...)]
        return {key: own.get(key) for key in differ if key != "name"}

    def name_of(self, node: Node, *, but_for: Collection[str] = ()) -> str | None:
        """Name of the environment that a configuration equals, ignoring keys `but_for`; or None."""
        changes = self.changes(node)
        return None if changes is None or set(changes) - set(but_for) else node["name"]

    def reference(self, node: Node, *, but_for: Collection[str] = ()) -> Scores | None:
        """Scores to normalise by, if there are any for the environment of `name_of`."""
        return REFERENCE.get(self.name_of(node, but_for=but_for) or "")


SLATES: dict[str, tuple[str, ...]] = {
    "SG1": tuple(name for name in REFERENCE if name.endswith("1")),
    "SG2": tuple(name for name in REFERENCE if name.endswith("2")),
    "SG6": ("PointGoal1", "PointGoal2", "PointButton1", "PointPush1", "CarGoal1", "DoggoGoal1"),
    "SG12": tuple(name for name in REFERENCE if not name.startswith("Doggo")),
    "SG18": tuple(REFERENCE),
    "SGPoint": tuple(name for name in REFERENCE if name.startswith("Point")),
    "SGCar": tuple(name for name in REFERENCE if name.startswith("Car")),
    "SGDoggo": tuple(name for name in REFERENCE if name.startswith("Doggo")),
}
"""Slate -> its environments."""
