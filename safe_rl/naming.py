"""Names: that of a nested key, and the known one most like a wrong one, with which errors end."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher, get_close_matches
from typing import Any

__all__ = ["did_you_mean", "key_name", "nearest"]

_LIKENESS = 0.5


def key_name(key: str | tuple[Any, ...]) -> str:
    """A key of a TensorDict, nested or not, as one string, its parts joined by ``/``.

    Examples:
        >>> key_name(("agents", "cost")), key_name("cost")
        ('agents/cost', 'cost')
    """
    return key if isinstance(key, str) else "/".join(key)


def nearest(name: str, known: Iterable[str], likeness: float = _LIKENESS) -> str | None:
    """Return the known name most like `name`, or None if none is like it.

    Args:
        name: The wrong one.
        known: The right ones.
        likeness: Ratio of difflib's below which two names have nothing to do with each other.

    Examples:
        >>> nearest("hazard_num", ["hazards_num", "vases_num"])
        'hazards_num'
        >>> nearest("zzz", ["hazards_num"]) is None
        True
    """
    close = get_close_matches(name, list(known), n=5, cutoff=likeness)
    # of equally close ones, one of the same letters, then the one of the most similar length
    return max(close, key=lambda found: _likeness(name, found), default=None)


def _likeness(name: str, found: str) -> tuple[float, bool, int]:
    ratio = SequenceMatcher(None, found, name).ratio()
    return round(ratio, 6), sorted(found) == sorted(name), -abs(len(found) - len(name))


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a sentence to append to an error, with its space, or nothing if no name is like it.

    Examples:
        >>> did_you_mean("cop", ["cpo", "cup", "ppo"])
        " Did you mean 'cpo'?"
    """
    close = nearest(name, known)
    return "" if close is None else f" Did you mean '{close}'?"
