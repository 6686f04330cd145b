"""Keys of environments: a type with its range, a default and a meaning each, also for Hydra.

Also the error for a key that cannot be used, and the names of costs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import field, make_dataclass
from functools import cache, partial
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Optional, Union, get_args, get_origin

from annotated_types import Interval

from safe_rl import checks
from safe_rl.checks import SettingError, rule


class ConfigError(ValueError):
    """A configuration cannot be used; the message names the key and what to change."""


# float32 can hold the square of the largest number
Number = Annotated[float, Interval(ge=-1e9, le=1e9)]
Positive = Annotated[float, Interval(gt=0, le=1e9)]
NotNegative = Annotated[float, Interval(ge=0, le=1e9)]
Count = Annotated[int, Interval(ge=1, le=10**15)]
Seed = Annotated[int, Interval(ge=0, lt=2**63)]
Backend = Literal["cpu", "warp"]
Threads = Annotated[int, Interval(ge=0, le=10**6)]
_RANGE = rule(lambda row: row[0] <= row[1], "a factor, or the lowest and the highest one")
Factor = Positive | Annotated[tuple[Positive, Positive], _RANGE]
"""A factor, or the range from which one is drawn for every episode."""
FactorOrZero = NotNegative | Annotated[tuple[NotNegative, NotNegative], _RANGE]


class Key(NamedTuple):
    """A configuration key.

    Attributes:
        default: Its default value.
        annotation: Its type and range, such as `float | None` or pydantic's `PositiveFloat`.
        meaning: Its meaning, for the table of keys.
    """

    default: Any
    annotation: Any
    meaning: str = ""


adapter = cache(checks.adapter)


def check_key(name: str, annotation: Any, value: Any) -> Any:
    """Return a value with the type of its key; ConfigError if the type or range is wrong."""
    check = adapter(annotation)
    try:
        # check_value returns the value as it is; this converts it to the type, as a list to a tuple
        return check.validate_python(checks.check_value(name, check, as_plain(value)))
    except SettingError as error:
        raise ConfigError(str(error)) from None


def as_plain(value: Any) -> Any:
    """Return numbers of NumPy and torch as Python's, and their arrays, lists, … as tuples."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        return value
    return tuple(map(as_plain, value))


def structured(name: str, keys: Mapping[str, Key]) -> type:
    """Return a dataclass of keys for Hydra's ConfigStore.

    Hydra then refuses unknown keys and wrong types. Ranges, choices and nested lists, which it
    cannot express, are checked when the environment is made.
    """
    rows = []
    for key_name, row in keys.items():
        kind, default = _hydra_type(row.annotation), row.default
        if isinstance(default, tuple):
            default = field(default_factory=partial(list, default))
        rows.append((key_name, kind, default))
    return make_dataclass(name, rows)


def _hydra_type(annotation: Any) -> Any:
    """Return the most specific type that OmegaConf knows for an annotation."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _hydra_type(inner[0])
    if origin is Literal:
        return type(inner[0])
    if origin in (Union, UnionType):
        kinds = {_hydra_type(kind) for kind in inner if kind is not NoneType}
        kind = kinds.pop() if len(kinds) == 1 else Any
        return Optional[kind] if NoneType in inner else kind  # noqa: UP045, as kind may be Any
    if origin in (list, tuple):
        item = _hydra_type(inner[0])
        return list[item] if item in (bool, int, float, str) else Any  # type: ignore[valid-type]
    return annotation if annotation in (bool, int, float, str) else Any


COST = "cost"


def is_cost(name: Any) -> bool:
    """Whether a name is that of a cost: `cost` or `cost_<kind>`."""
    return name == COST or str(name).startswith(f"{COST}_")


#: These names usually mean something else than the cost of a step. `cost_keys` can still name them.
_NOT_OF_STEPS = {
    *("cost_limit", "cost_threshold", "cost_budget"),
    *("cost_total", "cost_return", "cost_cumulative", "cost_episode"),
}


def found_costs(names: Iterable[Any]) -> list[str]:
    """Names of the costs of a step among those that an environment writes.

    Examples:
        >>> found_costs(["place", "cost", "cost_doors", "cost_limit", "cost_cumulative"])
        ['cost', 'cost_doors']
    """
    return [str(name) for name in names if is_cost(name) and name not in _NOT_OF_STEPS]
