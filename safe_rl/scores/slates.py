"""Sets of environments over which normalised scores are averaged (section 5.1 of the paper)."""

from __future__ import annotations

from safe_rl.scores.published import REFERENCE

__all__ = ["SLATES"]

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
