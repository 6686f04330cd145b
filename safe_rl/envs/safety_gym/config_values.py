"""Values of configuration keys, each by itself: how a key is declared, types and ranges."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from safe_rl.envs.errors import ConfigError, nearest

Rectangle = tuple[float, float, float, float]
Point2 = tuple[float, float]
Placements = tuple[Rectangle, ...] | None
Locations = tuple[Point2, ...]


LARGEST = 10**9  # of all numbers: float32 still holds its square
LARGEST_SEED = 2**62  # of layouts, which are hashed as 64-bit integers


class Range(NamedTuple):
    """Which values of its type a key may have.

    Attributes:
        wanted: in words, to stand behind "must be"; "" if only the size is bounded.
        holds: whether a number, or each one of several, is among them; None always is.
        largest: bound of the absolute value.
        choices: all of them, if they are few.
    """

    wanted: str
    holds: Callable[[Any], bool]
    largest: int = LARGEST
    choices: tuple[Any, ...] = ()

    def up_to(self, largest: int) -> Range:
        """Return the same with another bound: what memory and time allow."""
        return self._replace(largest=largest)

    def __str__(self) -> str:
        bound = "" if self.largest == LARGEST else f"at most {self.largest:,}"
        return ", ".join(filter(None, (self.wanted, bound)))


ANY = Range("", lambda x: True)
POSITIVE = Range("greater than 0", lambda x: x > 0)
NOT_NEGATIVE = Range("0 or more", lambda x: x >= 0)
OBJECTS = NOT_NEGATIVE.up_to(1000)
FREE_OBJECTS = NOT_NEGATIVE.up_to(200)  # whose contacts still fit into the physics' memory
PROBABILITY = Range("a probability between 0 and 1", lambda x: 0.0 <= x <= 1.0)


def one_of(*choices: Any) -> Range:
    """Range of a few values."""
    return Range(f"one of {choices}", lambda x: x in choices, choices=choices)


def key(default: Any, meaning: str, range: Range = ANY) -> Any:
    """Declare a key: the field of a dataclass, whose annotation is the key's type."""
    return dataclasses.field(default=default, metadata={"meaning": meaning, "range": range})


def _wrong(key: str, wanted: str, value: Any) -> ConfigError:
    return ConfigError(f"Configuration key '{key}' must be {wanted}, got {value!r}.")


def _python(value: Any) -> Any:
    """A number, truth value or text of NumPy's as one of Python's; all else as it is."""
    return value.item() if isinstance(value, np.generic) else value


def _boolean(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise _wrong(key, "True or False", value)
    return value


def _integer(key: str, value: Any) -> int:
    is_whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not is_whole:
        raise _wrong(key, "an integer", value)
    return int(value)


def _number(key: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool | str) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise _wrong(key, "a finite number", value)
    return number


def _text(key: str, value: Any) -> str:
    if not isinstance(value, str):
        raise _wrong(key, "a string", value)
    return value


def _sequence(key: str, value: Any) -> list[Any]:
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        raise _wrong(key, "a list", value)
    return list(value)


def _tuple_of(parse: Any, length: int | None = None) -> Any:
    def parse_all(key: str, value: Any) -> tuple[Any, ...]:
        items = _sequence(key, value)
        if length is not None and len(items) != length:
            raise _wrong(key, f"a list of {length} values", value)
        return tuple(parse(key, _python(item)) for item in items)

    return parse_all


def _optional(parse: Any) -> Any:
    return lambda key, value: None if value is None else parse(key, value)


_PARSERS = {
    "bool": _boolean,
    "int": _integer,
    "float": _number,
    "str": _text,
    "int | None": _optional(_integer),
    "float | None": _optional(_number),
    "Rectangle": _tuple_of(_number, 4),
    "Placements": _optional(_tuple_of(_tuple_of(_number, 4))),
    "Locations": _tuple_of(_tuple_of(_number, 2)),
    "tuple[str, ...]": _tuple_of(_text),
    "tuple[float, ...]": _tuple_of(_number),
    "tuple[int, int]": _tuple_of(_integer, 2),
}


def coerce(key: str, annotation: str, value: Any, range: Range = ANY) -> Any:
    """Return `value` as the type that the field's annotation names, within the key's range.

    Raises:
        ConfigError: if it is of another type, or out of range.
    """
    if annotation not in _PARSERS:
        raise ConfigError(f"The type of key '{key}' must be one of {tuple(_PARSERS)}.")
    value = _PARSERS[annotation](key, _python(value))
    if range.choices:
        check_choice(key, value, range.choices)
    numbers = _numbers(value)
    if not all(range.holds(number) for number in numbers):
        raise _wrong(key, range.wanted, value)
    if not all(abs(number) <= range.largest for number in numbers):
        raise _wrong(key, f"at most {range.largest:,}", value)
    if annotation in ("Placements", "Rectangle"):
        _check_rectangles(key, value if annotation == "Placements" else (value,), value)
    return value


def _numbers(value: Any) -> list[float]:
    """The numbers in a value, also in lists of lists."""
    if isinstance(value, tuple):
        return [number for item in value for number in _numbers(item)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def infer_annotation(key: str, default: Any) -> str:
    """Return the annotation of the type that a default value has.

    Raises:
        ConfigError: if the default alone does not tell.
    """
    kinds = ("bool", "int", "float", "str")
    if type(default).__name__ in kinds:
        return type(default).__name__
    if isinstance(default, tuple) and default and type(default[0]) in (int, float):
        return "tuple[float, ...]"
    if isinstance(default, tuple) and default and isinstance(default[0], str):
        return "tuple[str, ...]"
    raise ConfigError(
        f"The type of key '{key}' does not follow from its default {default!r}: give "
        f"Key(default, annotation) with one of {tuple(_PARSERS)}."
    )


# Of keys that are registered without a range, by how they end.
_RANGES = {
    ("_size", "_density", "_height", "_radius", "max_dist"): POSITIVE,
    ("_keepout", "_threshold", "_delay", "_travel", "_noise", "_gain"): NOT_NEGATIVE,
    ("_num",): OBJECTS,
}


def infer_range(key: str) -> Range:
    """Return the range that a key of this name has among the built-in ones."""
    return next((range for ends, range in _RANGES.items() if key.endswith(ends)), ANY)


def check_choice(key: str, value: Any, choices: Collection[Any]) -> None:
    """Check that a value is one of several.

    Raises:
        ConfigError: if it is none of them; the nearest one is named.
    """
    if value not in choices:
        hint = nearest(value, map(str, choices)) if isinstance(value, str) else ""
        raise ConfigError(f"'{key}' must be one of {tuple(choices)}, got {value!r}.{hint}")


def check_retired(key: str, value: Any, harmless: Any, instead: str) -> None:
    """Check a key that has lost its meaning.

    Raises:
        ConfigError: if its value asks for something; the message says what to do instead.
    """
    if _python(value) is not harmless:
        raise ConfigError(f"Configuration key '{key}' is no more: {instead}. Got {value!r}.")


def _check_rectangles(key: str, rectangles: Placements, value: Any) -> None:
    if rectangles == ():
        raise _wrong(key, "None or a list of at least one rectangle", value)
    for xmin, ymin, xmax, ymax in rectangles or ():
        if xmin > xmax or ymin > ymax:
            raise _wrong(key, "(xmin, ymin, xmax, ymax) with xmin <= xmax, ymin <= ymax", value)
