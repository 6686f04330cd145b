"""Annotations of parameters, and the sets of values that they stand for.

A constructor annotates its arguments, ``gamma: Share`` or ``size: Annotated[int, Range(1, 100)]``,
and `values_of` turns an annotation into a check and a description for messages.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union
from typing import get_args as arguments_of
from typing import get_origin as origin_of


class Values(NamedTuple):
    """A set of values; as metadata of `Annotated`, those that a parameter may have.

    Attributes:
        hold: Function that tells whether a value is one of them.
        words: Their description, to follow "it must be".
        whole: Whether they are whole numbers, which may be floats, such as YAML's 3e5.

    Examples:
        >>> even = Values(lambda value: value in (2, 4), "2 or 4")
        >>> values_of(Annotated[int, even] | None).words
        '2 or 4, or null'
    """

    hold: Callable[[Any], bool]
    words: str
    whole: bool = False


@dataclass(frozen=True)
class Range:
    """Bounds of a finite number.

    Args:
        low: Lower bound; None: -1e9, or -10¹⁵ for whole numbers.
        high: Upper bound; None: 1e9, or 10¹⁵ for whole numbers.
        above: Whether the lower bound itself is excluded.
        below: Whether the upper bound itself is excluded.

    Examples:
        >>> values_of(Annotated[float, Range(0, 1, above=True)]).words
        'a number above 0 and at most 1'
        >>> values_of(Annotated[int, Range(1, 9)]).hold(1.5)
        False
    """

    low: float | None = None
    high: float | None = None
    above: bool = False
    below: bool = False


def is_number(value: Any) -> bool:
    """Whether a value is a number that a float can hold, and finite; True and False are not."""
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    return is_real and abs(value) <= sys.float_info.max


def is_text(value: Any) -> bool:
    """Whether a value is a text of one line that is not empty."""
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


ANYTHING = Values(lambda value: True, "anything")
_BOOLEAN = Values(lambda value: isinstance(value, bool), "true or false")
_NULL = Values(lambda value: value is None, "null")
_TEXT = Values(is_text, "a text that is not empty")
PART = Values(
    lambda value: isinstance(value, Mapping) and is_text(value.get("_target_")),
    "a part with a _target_, as the files in conf/ have it",
)
"""For a parameter whose argument is built from another node of the configuration."""

Number = Annotated[float, Range()]
Positive = Annotated[float, Range(0, above=True)]
NotNegative = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]
Fraction = Annotated[float, Range(0, 1, above=True)]
"""A share above 0."""
Weight = Annotated[float, Range(0, 1, below=True)]
"""A share below 1, such as the weight of the past in a moving average."""
Count = Annotated[int, Range(1)]
Text = Annotated[str, _TEXT]


def values_of(annotation: Any) -> Values:
    """The values that an annotation allows; any value if it has no meaning here.

    Floats have to be finite. `Literal` names choices, and ``X | None`` allows null. Lists, tuples
    and mappings are checked item by item.

    Examples:
        >>> size = values_of(list[Annotated[int, Range(1, 64)]])
        >>> size.hold([8, 64]), size.hold([65]), size.hold(8)
        (True, False, False)
        >>> values_of(Literal["kl", "l2"]).words
        'one of kl, l2'
        >>> values_of(float | Literal["auto"]).words
        'a number from -1e+09 to 1e+09, or auto'
    """
    origin, inner = origin_of(annotation), arguments_of(annotation)
    if origin is Annotated:
        return _narrowed(inner[0], inner[1:])
    if origin is Literal:
        return _choice(inner)
    if origin in (Union, UnionType):
        return reduce(_either, sorted(map(values_of, inner), key=lambda v: v is _NULL))
    if origin is tuple and Ellipsis not in inner:
        return _items(reduce(_either, map(values_of, dict.fromkeys(inner))), len(inner), exact=True)
    kind = origin or annotation
    if isinstance(kind, type) and inner and issubclass(kind, Mapping):
        return _mapping(values_of(inner[1]))
    if isinstance(kind, type) and inner and issubclass(kind, Iterable):
        return _items(values_of(inner[0]), 1000)
    return _PLAIN.get(kind, ANYTHING) if isinstance(kind, type | NoneType) else ANYTHING


def is_described(annotation: Any) -> bool:
    """Whether an annotation describes a hyper-parameter: it has a range or choices, or is bool.

    Other arguments, such as ``device: str``, are passed by the program.

    Examples:
        >>> is_described(Share | None), is_described(bool), is_described(float)
        (True, True, False)
    """
    if annotation is bool or origin_of(annotation) in (Annotated, Literal):
        return True
    return any(map(is_described, arguments_of(annotation)))


def _narrowed(kind: Any, metadata: Collection[Any]) -> Values:
    """The values that the first known metadata allows; those of the type if there is none."""
    for item in metadata:
        if isinstance(item, Values):
            return item
        if isinstance(item, Range):
            return _within(item, whole=kind is int)
    bounds = {
        name: value
        for item in metadata
        for name in ("gt", "ge", "lt", "le")
        if (value := getattr(item, name, None)) is not None
    }
    if not bounds:
        return values_of(kind)
    low, high = (bounds.get(a, bounds.get(b)) for a, b in (("gt", "ge"), ("lt", "le")))
    if kind is int and "gt" in bounds:
        low, bounds = low + 1, {}
    return _within(Range(low, high, "gt" in bounds, "lt" in bounds), whole=kind is int)


def _within(range: Range, *, whole: bool) -> Values:
    most = 10**15 if whole else 1e9  # float32 can hold the square of 1e9
    lowest = -most if range.low is None else range.low
    highest = most if range.high is None else range.high

    def hold(value: Any) -> bool:
        if not is_number(value) or not lowest <= value <= highest:
            return False
        if whole and value != int(value):
            return False
        return not (range.above and value == lowest) and not (range.below and value == highest)

    if whole:
        return Values(hold, f"a whole number from {lowest} to {highest:,}", whole=True)
    low = f"above {lowest:g}" if range.above else f"from {lowest:g}"
    high = f"{'at most' if range.above else 'to'} {highest:g}"
    if range.below:
        high = f"below {highest:g}"
    join = " and " if range.above or range.below else " "
    return Values(hold, f"a number {low}{join}{high}")


def _choice(names: Sequence[Any]) -> Values:
    words = f"one of {', '.join(map(str, names))}" if names[1:] else str(names[0])
    return Values(lambda value: any(type(n) is type(value) and n == value for n in names), words)


def _either(first: Values, second: Values) -> Values:
    words = f"{first.words}, or {second.words.replace(first.words, 'of these')}"
    return Values(lambda v: first.hold(v) or second.hold(v), words, first.whole or second.whole)


def _items(item: Values, number: int, exact: bool = False) -> Values:
    def hold(value: Any) -> bool:
        is_list = isinstance(value, list | tuple) and len(value) <= number
        return is_list and all(map(item.hold, value)) and not (exact and len(value) < number)

    length = f"{number}" if exact else f"at most {number}"
    return Values(hold, f"a list of {length} items, each {item.words}", item.whole)


def _mapping(item: Values) -> Values:
    return Values(
        lambda v: (
            isinstance(v, Mapping) and all(map(is_text, v)) and all(map(item.hold, v.values()))
        ),
        f"a mapping from names to values, such as '{{name: …}}', each {item.words}",
        item.whole,
    )


_PLAIN: dict[Any, Values] = {
    **{bool: _BOOLEAN, str: _TEXT, None: _NULL, NoneType: _NULL},
    **{kind: _within(Range(), whole=kind is int) for kind in (int, float)},
}


Options = Annotated[dict[str, Any], _mapping(ANYTHING)]
"""For a parameter that is passed on to another library."""
