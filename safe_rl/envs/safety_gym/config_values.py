"""Declaration of a configuration key, and the check of its value."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Annotated, Any, NamedTuple

from safe_rl.envs.errors import ConfigError
from safe_rl.ranges import Range, Values, values_of

LARGEST_SEED = 2**62  # of layouts; layout seeds are hashed as 64-bit integers

Objects = Annotated[int, Range(0, 1000)]
FreeObjects = Annotated[int, Range(0, 200)]
"""Number of movable objects; the contacts of more would not fit into the physics' memory."""
Pixels = tuple[Annotated[int, Range(1, 4096)], Annotated[int, Range(1, 4096)]]

_FOUR = values_of(tuple[float, float, float, float])
_RECTANGLE = "(xmin, ymin, xmax, ymax) with xmin <= xmax and ymin <= ymax"


def _is_rectangle(value: Any) -> bool:
    return _FOUR.hold(value) and value[0] <= value[2] and value[1] <= value[3]


def _are_rectangles(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) > 0 and all(map(_is_rectangle, value))


Rectangle = Annotated[tuple[float, float, float, float], Values(_is_rectangle, _RECTANGLE)]
Placements = (
    Annotated[
        tuple[tuple[float, float, float, float], ...],
        Values(_are_rectangles, f"a list of at least one {_RECTANGLE}"),
    ]
    | None
)
Locations = tuple[tuple[float, float], ...]


class Key(NamedTuple):
    """A configuration key.

    Attributes:
        default: Its default value.
        annotation: Its type and range, such as `float | None` or `safe_rl.ranges.Positive`.
        meaning: Its meaning, for the table of keys.
    """

    default: Any
    annotation: Any
    meaning: str = ""


def key(default: Any, meaning: str) -> Any:
    """Declare a key of the class `Vocabulary`, where its annotation gives the type and range."""
    return Key(default, None, meaning)


allowed = cache(values_of)
"""Returns the allowed values of keys with an annotation."""


def coerce(name: str, key: Key, value: Any) -> Any:
    """Return a value as the type of its key; ConfigError if the type or range is wrong."""
    if isinstance(key.annotation, str):
        raise ConfigError(f"The type of key '{name}' must be a type, not {key.annotation!r}.")
    values, plain = allowed(key.annotation), _plain(value)
    if not values.hold(plain):
        raise ConfigError(f"Configuration key '{name}' must be {values.words}, got {value!r}.")
    return _cast(plain, int if values.whole else float)


def _plain(value: Any) -> Any:
    """Return numbers of NumPy and torch as Python's, and their arrays, lists, … as tuples."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        return value
    return tuple(map(_plain, value))


def _cast(value: Any, kind: type) -> Any:
    """Convert all numbers in a value to one type."""
    if isinstance(value, tuple):
        return tuple(_cast(item, kind) for item in value)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return kind(value) if is_number else value


def infer_key(name: str, default: Any) -> Key:
    """Return a key with the type of its default; ConfigError if the type is not clear."""
    kind = type(default[0] if isinstance(default, tuple) and default else default)
    if kind not in (bool, int, float, str):
        raise ConfigError(
            f"The type of key '{name}' does not follow from its default {default!r}: give "
            "Key(default, annotation), such as Key(None, float | None)."
        )
    if isinstance(default, tuple):
        return Key(default, tuple[float if kind is int else kind, ...])  # type: ignore[misc]
    return Key(default, kind)
