"""Which environments are exactly the benchmark's, so that published scores hold on them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from safe_rl.scores.published import REFERENCE, Scores

__all__ = ["SLATES", "Suite"]

Node = Mapping[str, Any]


@dataclass(frozen=True)
class Suite:
    """The benchmark's environments, as configurations.

    Attributes:
        environments: Name -> all its keys, as a run's configuration holds them.
        defaults: Value of every key where a configuration leaves it out.

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
        """Keys in which a configuration differs from the environment whose name it has.

        Returns:
            Key -> value, or None if the suite has no environment of that name.
        """
        name = node.get("name")
        standard = self.environments.get(name) if isinstance(name, str) else None
        if standard is None:
            return None
        own = {**self.defaults, **node}
        keys = dict.fromkeys([*standard, *own])
        return {key: own.get(key) for key in keys if key != "name" and _differ(key, own, standard)}

    def name_of(self, node: Node, *, but_for: Collection[str] = ()) -> str | None:
        """Name of the environment that a configuration is exactly, or None.

        Args:
            node: A run's ``env``.
            but_for: Keys that may differ.
        """
        changes = self.changes(node)
        return None if changes is None or set(changes) - set(but_for) else node["name"]

    def reference(self, node: Node, *, but_for: Collection[str] = ()) -> Scores | None:
        """Scores to normalise by, if a configuration is exactly an environment that has any."""
        return REFERENCE.get(self.name_of(node, but_for=but_for) or "")


def _differ(key: str, own: Node, standard: Node) -> bool:
    # before there were other families of environments, none was named
    if key == "_target_" and key not in own:
        return False
    return key not in standard or key not in own or _plain(own[key]) != _plain(standard[key])


def _plain(value: Any) -> Any:
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


SLATES: dict[str, tuple[str, ...]] = {
    "SG1": tuple(name for name in REFERENCE if name.endswith("1")),
    "SG2": tuple(name for name in REFERENCE if name.endswith("2")),
    "SG6": ("PointGoal1", "PointGoal2", "PointButton1", "PointPush1", "CarGoal1", "DoggoGoal1"),
    "SG18": tuple(REFERENCE),
    "SGPoint": tuple(name for name in REFERENCE if name.startswith("Point")),
    "SGCar": tuple(name for name in REFERENCE if name.startswith("Car")),
    "SGDoggo": tuple(name for name in REFERENCE if name.startswith("Doggo")),
}


"""Slate -> its environments."""
