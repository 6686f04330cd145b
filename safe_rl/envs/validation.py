"""Checks of configuration values: types, ranges, choices, and errors that say what to change."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

ROBOTS = ("point", "car", "doggo")
TASKS = ("goal", "button", "push", "x", "z", "circle", "none")


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the key and what to change."""


def nearest(name: str, known: Iterable[str]) -> str:
    """Return " Did you mean 'x'?" for the known name most like `name`, or an empty string."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" Did you mean '{close[0]}'?" if close else ""


def _wrong(key: str, wanted: str, value: Any) -> ConfigError:
    return ConfigError(f"Configuration key '{key}' must be {wanted}, got {value!r}.")


def _boolean(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise _wrong(key, "True or False", value)
    return value


def _integer(key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or value != int(value):
        raise _wrong(key, "an integer", value)
    return int(value)


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _wrong(key, "a finite number", value)
    return float(value)


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
    "float | None": _optional(_number),
    "Rectangle": _tuple_of(_number, 4),
    "Placements": _optional(_tuple_of(_tuple_of(_number, 4))),
    "Locations": _tuple_of(_tuple_of(_number, 2)),
    "tuple[str, ...]": _tuple_of(_text),
    "tuple[float, ...]": _tuple_of(_number),
    "tuple[int, int]": _tuple_of(_integer, 2),
}


def coerce(key: str, annotation: str, value: Any) -> Any:
    """Return `value` as the type that the field's annotation names, or raise ConfigError."""
    return _PARSERS[annotation](key, value)


_CHOICES = {"task": TASKS, "lidar_type": ("pseudo", "natural"), "compass_shape": (2, 3)}
_POSITIVE = (
    *("num_steps", "frameskip_binom_n", "lidar_num_bins", "circle_radius", "pillars_height"),
    *(f"{kind}_size" for kind in ("goal", "box", "walls", "hazards", "vases", "pillars")),
    *("buttons_size", "gremlins_size", "box_density", "vases_density", "gremlins_density"),
)
_NOT_NEGATIVE_ENDINGS = ("_num", "_keepout", "_threshold", "_delay", "_travel", "_noise", "_gain")


def validate(config: Mapping[str, Any]) -> None:
    """Check values of the right type: choices, ranges, and what they need of one another.

    Raises:
        ConfigError: naming the first key that is wrong.
    """
    _validate_choices(config)
    for key, value in config.items():
        if key in _POSITIVE and not value > 0:
            raise _wrong(key, "greater than 0", value)
        if key.endswith(_NOT_NEGATIVE_ENDINGS) and value < 0:
            raise _wrong(key, "0 or more", value)
        if key == "placements_extents" or key.endswith("_placements"):
            _validate_rectangles(key, value)
    probability = config["frameskip_binom_p"]
    if not 0.0 <= probability <= 1.0:
        raise _wrong("frameskip_binom_p", "a probability between 0 and 1", probability)
    max_dist = config["lidar_max_dist"]
    if max_dist is not None and not max_dist > 0:
        raise _wrong("lidar_max_dist", "greater than 0, or None", max_dist)
    if config["task"] == "button" and config["buttons_num"] < 1:
        raise ConfigError("'task' button needs at least one button: set 'buttons_num'.")


def _validate_choices(config: Mapping[str, Any]) -> None:
    for key, choices in _CHOICES.items():
        value = config[key]
        if value not in choices:
            hint = nearest(value, choices) if isinstance(value, str) else ""
            raise ConfigError(f"'{key}' must be one of {choices}, got {value!r}.{hint}")
    robot = config["robot_base"]
    if robot.endswith(".xml"):
        if not Path(robot).is_file():
            raise ConfigError(f"'robot_base': there is no file {robot!r}.")
    elif robot not in ROBOTS:
        raise ConfigError(
            f"'robot_base' must be one of {ROBOTS} or the path of an MJCF (.xml) file, "
            f"got {robot!r}.{nearest(robot, ROBOTS)}"
        )


def _validate_rectangles(key: str, value: Any) -> None:
    rectangles = (value,) if key == "placements_extents" else value or ()
    if value == ():
        raise _wrong(key, "None or a list of at least one rectangle", value)
    for xmin, ymin, xmax, ymax in rectangles:
        if xmin > xmax or ymin > ymax:
            raise _wrong(key, "(xmin, ymin, xmax, ymax) with xmin <= xmax, ymin <= ymax", value)
