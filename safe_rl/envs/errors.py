"""Errors that say what to change, and the nearest right name for a wrong one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the key and what to change."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" for the known name most like `name`, or an empty string."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" Did you mean '{close[0]}'?" if close else ""


def require_integer(name: str, value: Any, lowest: int, highest: int = 2**63 - 1) -> None:
    """Check an argument that counts or seeds.

    Raises:
        ConfigError: if it is no integer between the bounds.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= highest:
        raise ConfigError(f"'{name}' must be an integer of at least {lowest}, got {value!r}.")
