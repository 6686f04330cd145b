"""Values of configuration keys, each by itself: how a key is declared, types and ranges."""

from __future__ import annotations

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


class Key(NamedTuple):
    """A configuration key.

    Attributes:
        default: its value where none is given.
        annotation: its type, as `Vocabulary` writes it.
        meaning: what it is, for the table of keys.
        range: which values it may have; None takes that of built-in keys which end alike.
    """

    default: Any
    annotation: str
    meaning: str = ""
    range: Range | None = None


def key(default: Any, meaning: str, range: Range = ANY) -> Any:
    """Declare a key of the vocabulary, whose annotation there is its type."""
    return Key(default, "", meaning, range)


def _boolean(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


def _integer(value: Any) -> int:
    is_whole = isinstance(value, int) or (isinstance(value, float) and value.is_integer())
    if isinstance(value, bool) or not is_whole:
        raise TypeError
    return int(value)


def _number(value: Any) -> float:
    if isinstance(value, bool | str) or not math.isfinite(number := float(value)):
        raise TypeError
    return number


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value


def _tuple_of(parse: Callable[[Any], Any], length: int | None = None) -> Callable[[Any], Any]:
    def parse_all(value: Any) -> tuple[Any, ...]:
        if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
            raise TypeError
        items = tuple(parse(_python(item)) for item in value)
        if length is not None and len(items) != length:
            raise ValueError
        return items

    return parse_all


def _rectangle(value: Any) -> Rectangle:
    xmin, ymin, xmax, ymax = _tuple_of(_number, 4)(value)
    if xmin > xmax or ymin > ymax:
        raise ValueError
    return xmin, ymin, xmax, ymax


def _placements(value: Any) -> Placements:
    if not (rectangles := _tuple_of(_rectangle)(value)):
        raise ValueError
    return rectangles


def _or_none(parse: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: None if value is None else parse(value)


_RECTANGLE = "(xmin, ymin, xmax, ymax) with xmin <= xmax and ymin <= ymax"
# annotation -> its name in words, to stand behind "must be", and how a value of it is read
TYPES: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "bool": ("True or False", _boolean),
    "int": ("an integer", _integer),
    "float": ("a number", _number),
    "str": ("a text", _text),
    "int | None": ("an integer or None", _or_none(_integer)),
    "float | None": ("a number or None", _or_none(_number)),
    "Rectangle": (_RECTANGLE, _rectangle),
    "Placements": (f"a list of at least one {_RECTANGLE}; or None", _or_none(_placements)),
    "Locations": ("a list of (x, y)", _tuple_of(_tuple_of(_number, 2))),
    "tuple[str, ...]": ("a list of texts", _tuple_of(_text)),
    "tuple[float, ...]": ("a list of numbers", _tuple_of(_number)),
    "tuple[int, int]": ("two integers", _tuple_of(_integer, 2)),
}


def coerce(name: str, key: Key, value: Any) -> Any:
    """Return `value` as the type of a key, within the key's range; ConfigError if it is not."""
    if key.annotation not in TYPES:
        raise ConfigError(f"The type of key '{name}' must be one of {tuple(TYPES)}.")
    words, parse = TYPES[key.annotation]
    try:
        value = parse(_python(value))
    except (TypeError, ValueError, OverflowError):
        raise _wrong(name, words, value) from None
    range = infer_range(name) if key.range is None else key.range
    if range.choices:
        check_choice(name, value, range.choices)
    numbers = _numbers(value)
    if not all(range.holds(number) for number in numbers):
        raise _wrong(name, range.wanted, value)
    if not all(abs(number) <= range.largest for number in numbers):
        raise _wrong(name, f"at most {range.largest:,}", value)
    return value


def _wrong(name: str, wanted: str, value: Any) -> ConfigError:
    return ConfigError(f"Configuration key '{name}' must be {wanted}, got {value!r}.")


def _python(value: Any) -> Any:
    """A number, truth value or text of NumPy as one of Python; anything else as it is."""
    return value.item() if isinstance(value, np.generic) else value


def _numbers(value: Any) -> list[float]:
    """The numbers in a value, also in lists of lists."""
    if isinstance(value, tuple):
        return [number for item in value for number in _numbers(item)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def infer_key(name: str, default: Any) -> Key:
    """Return the key of the type that a default value has; ConfigError if it does not tell."""
    kind = type(default[0] if isinstance(default, tuple) and default else default)
    name_of = {bool: "bool", int: "int", float: "float", str: "str"}.get(kind)
    if isinstance(default, tuple):
        name_of = {"int": "float", "float": "float", "str": "str"}.get(name_of or "")
        name_of = name_of and f"tuple[{name_of}, ...]"
    if name_of is None:
        raise ConfigError(
            f"The type of key '{name}' does not follow from its default {default!r}: give "
            f"Key(default, annotation) with one of {tuple(TYPES)}."
        )
    return Key(default, name_of)


# Of keys that are registered without a range, by how they end.
_RANGES = {
    ("_size", "_density", "_height", "_radius", "max_dist"): POSITIVE,
    ("_keepout", "_threshold", "_delay", "_travel", "_noise", "_gain"): NOT_NEGATIVE,
    ("_num",): OBJECTS,
}


def infer_range(name: str) -> Range:
    """Return the range that a key of this name has among the built-in ones."""
    return next((range for ends, range in _RANGES.items() if name.endswith(ends)), ANY)


def check_choice(name: str, value: Any, choices: Collection[Any]) -> None:
    """Check that a value is one of several; ConfigError names the nearest one."""
    if value not in choices:
        hint = nearest(value, map(str, choices)) if isinstance(value, str) else ""
        raise ConfigError(f"'{name}' must be one of {tuple(choices)}, got {value!r}.{hint}")
