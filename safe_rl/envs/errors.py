"""Errors that say what to change, and suggestions for a misspelled name."""

from __future__ import annotations

from typing import Any


class ConfigError(ValueError):
    """A configuration cannot be used; the message names the key and what to change."""


def on_cpu_only(key: str) -> str:
    """Return a hint for MuJoCo Warp's keys, which only Safety Gym has; else an empty text."""
    if key not in ("physics", "physics_buffers"):
        return ""
    return (
        f" Only Safety Gym's environments have '{key}': the physics of all others, such as the "
        "velocity family, runs on the CPU only. Remove it, and preset=gpu, which sets 'physics'."
    )


def require_integer(name: str, value: Any, lowest: int) -> None:
    """Raise ConfigError unless an argument is an integer from `lowest` to 2⁶³ - 1."""
    if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value < 2**63:
        words = f"an integer of at least {lowest} and below 2**63"
        raise ConfigError(f"'{name}' must be {words}, got {value!r}.")
