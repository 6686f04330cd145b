"""Values of configuration keys, each by itself: types, ranges, choices."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from safe_rl.envs.errors import ConfigError, nearest


def _wrong(key: str, wanted: str, value: Any) -> ConfigError:
    return ConfigError(f"Configuration key '{key}' must be {wanted}, got {value!r}.")


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
        return tuple(parse(key, item) for item in items)

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


def coerce(key: str, annotation: str, value: Any) -> Any:
    """Return `value` as the type that the field's annotation names, within the key's range.

    Raises:
        ConfigError: if it is of another type, or out of range.
    """
    if annotation not in _PARSERS:
        raise ConfigError(f"The type of key '{key}' must be one of {tuple(_PARSERS)}.")
    value = _PARSERS[annotation](key, value)
    if key in _CHOICES:
        check_choice(key, value, _CHOICES[key])
    _check_range(key, value)
    if annotation == "Placements" or key == "placements_extents":
        _check_rectangles(key, value)
    return value


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


_CHOICES: Mapping[str, tuple[Any, ...]] = {
    "lidar_type": ("pseudo", "natural"),
    "compass_shape": (2, 3),
}
LARGEST_SEED = 2**62  # of layouts, which are hashed as 64-bit integers
# By the ends of keys, so that keys of registered elements are checked like the others.
_POSITIVE_ENDINGS = (
    *("_size", "_density", "_height", "_radius"),
    *("num_steps", "binom_n", "num_bins", "max_dist", "layout_seeds"),
)
_NOT_NEGATIVE_ENDINGS = (
    *("_num", "_keepout", "_threshold", "_delay", "_travel", "_noise", "_gain"),
    *("reward_clip", "seeds_first"),
)
# What memory and time allow: a lidar of more bins, or a picture of more pixels, fills a machine.
_LARGEST = {
    "_num": 1000,
    "num_bins": 10_000,
    "binom_n": 10_000,
    "vision_size": 4096,
    "vision_render_size": 4096,
    "layout_seeds": LARGEST_SEED,
    "layout_seeds_first": LARGEST_SEED,
}
_LARGEST_OF_ALL = 10**9  # whose square float32 still holds


def check_choice(key: str, value: Any, choices: Collection[Any]) -> None:
    """Check that a value is one of several.

    Raises:
        ConfigError: if it is none of them; the nearest one is named.
    """
    if value not in choices:
        hint = nearest(value, map(str, choices)) if isinstance(value, str) else ""
        raise ConfigError(f"'{key}' must be one of {tuple(choices)}, got {value!r}.{hint}")


def _check_range(key: str, value: Any) -> None:
    numbers = _numbers(value)
    if key.endswith(_POSITIVE_ENDINGS) and not all(x > 0 for x in numbers):
        raise _wrong(key, "greater than 0", value)
    if key.endswith(_NOT_NEGATIVE_ENDINGS) and not all(x >= 0 for x in numbers):
        raise _wrong(key, "0 or more", value)
    largest = next((_LARGEST[end] for end in _LARGEST if key.endswith(end)), _LARGEST_OF_ALL)
    if not all(abs(x) <= largest for x in numbers):
        raise _wrong(key, f"at most {largest:,}", value)
    if key == "frameskip_binom_p" and not 0.0 <= value <= 1.0:
        raise _wrong(key, "a probability between 0 and 1", value)


def _numbers(value: Any) -> list[float]:
    """The numbers in a value, also in lists of lists."""
    if isinstance(value, tuple):
        return [number for item in value for number in _numbers(item)]
    return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def _check_rectangles(key: str, value: Any) -> None:
    rectangles = (value,) if key == "placements_extents" else value or ()
    if value == ():
        raise _wrong(key, "None or a list of at least one rectangle", value)
    for xmin, ymin, xmax, ymax in rectangles:
        if xmin > xmax or ymin > ymax:
            raise _wrong(key, "(xmin, ymin, xmax, ymax) with xmin <= xmax, ymin <= ymax", value)
