"""Names of nested keys, and the nearest known name for error messages."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

STEPS_TAKEN = "steps_taken"
"""Key below "next": the number of environment steps that an action was held for, [..., 1]."""

_LIKENESS = 0.5
_BEGINNING = 4
"""Shortest name that may count as the beginning of another one [letters]."""


def key_name(key: str | tuple[Any, ...]) -> str:
    """A key of a TensorDict, nested or not, as one string, its parts joined by ``/``.

    Examples:
        >>> key_name(("agents", "cost")), key_name("cost")
        ('agents/cost', 'cost')
    """
    return key if isinstance(key, str) else "/".join(key)


def join_keys(above: str, name: str) -> str:
    """The dotted key of a name below another key, which is "" at the top level."""
    return f"{above}.{name}" if above else str(name)


def nearest(name: str, known: Iterable[str], likeness: float = _LIKENESS) -> str | None:
    """Return the known name that is most similar to `name`, or None if none is similar.

    Names are similar if difflib's SequenceMatcher gives them a ratio of at least `likeness`.
    Capitals are ignored, and hyphens count as underscores.

    Examples:
        >>> nearest("hazard_num", ["hazards_num", "vases_num"])
        'hazards_num'
        >>> nearest("PPOLag", ["ppo", "ppo_lagrangian", "p3o"])
        'ppo_lagrangian'
        >>> nearest("zzz", ["hazards_num"]) is None
        True
    """
    wanted = _plain(name)
    names = {_plain(candidate): candidate for candidate in known}

    def rank(there: str) -> tuple[bool, bool]:
        # ppo_lagrangian begins with PPOLag
        begins = there.replace("_", "").startswith(wanted.replace("_", ""))
        return begins and len(name) >= _BEGINNING, sorted(there) == sorted(wanted)

    close = get_close_matches(wanted, names, len(names) or 1, likeness)  # the most similar first
    return names[max(close, key=rank)] if close else None


def _plain(name: str) -> str:
    return name.lower().replace("-", "_")


def did_you_mean(name: str, known: Iterable[str], likeness: float = _LIKENESS) -> str:
    """Return a sentence, after a space, to append to an error; "" if no name is similar.

    For names with a common beginning, such as costs, `likeness` has to be higher (see `nearest`).

    Examples:
        >>> did_you_mean("cop", ["cpo", "cup", "ppo"])
        " Did you mean 'cpo'?"
    """
    close = nearest(name, known, likeness)
    return "" if close is None else f" Did you mean '{close}'?"
