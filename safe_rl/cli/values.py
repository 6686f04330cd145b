"""What a key may hold: kinds of values, each with the words that say so."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

__all__ = [
    *("NOT_NEGATIVE", "POSITIVE", "SHARE", "Values", "anything", "boolean", "choice", "component"),
    *("count", "folder_name", "list_of", "mapping_of", "number", "one_or_per_cost", "optional"),
    "text",
]


class Values(NamedTuple):
    """A set of values.

    Attributes:
        hold: Whether a value is one of them.
        words: What they are, to follow "it must be".
        whole: Whether they are whole numbers, for which YAML's 3e5 is one too.

    Examples:
        >>> gamma = number(0, 1)
        >>> gamma.hold(0.99), gamma.hold(float("nan")), gamma.hold("abc"), gamma.words
        (True, False, False, 'a number from 0 to 1')
    """

    hold: Callable[[Any], bool]
    words: str
    whole: bool = False


def _is_number(value: Any) -> bool:
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    # a whole number may be too large to be a float
    return is_real and (isinstance(value, int) or math.isfinite(value))


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


def number(
    lowest: float = -1e9, highest: float = 1e9, *, above: bool = False, below: bool = False
) -> Values:
    """Finite numbers between two bounds; ``above`` and ``below`` leave the bounds themselves out.

    The default bounds keep a number within what float32 can square.
    """
    low = f"above {lowest:g}" if above else f"from {lowest:g}"
    high = f"below {highest:g}" if below else f"{'at most' if above else 'to'} {highest:g}"

    def hold(value: Any) -> bool:
        if not _is_number(value) or not lowest <= value <= highest:
            return False
        return not (above and value == lowest) and not (below and value == highest)

    join = " and " if above or below else " "
    return Values(hold, f"a number {low}{join}{high}")


def count(lowest: int = 1, highest: int = 10**15) -> Values:
    """Whole numbers between two bounds."""

    def hold(value: Any) -> bool:
        return _is_number(value) and lowest <= value <= highest and value == int(value)

    return Values(hold, f"a whole number from {lowest} to {highest:,}", whole=True)


def choice(*names: str) -> Values:
    """One of some names."""
    return Values(lambda value: value in names, f"one of {', '.join(names)}")


def list_of(item: Values, longest: int) -> Values:
    """Lists whose items are of one kind."""
    return Values(
        lambda v: isinstance(v, list) and len(v) <= longest and all(map(item.hold, v)),
        f"a list of at most {longest} items, each {item.words}",
        item.whole,
    )


def mapping_of(item: Values) -> Values:
    """Mappings from names to values of one kind."""
    return Values(
        lambda v: isinstance(v, dict) and all(map(_is_text, v)) and all(map(item.hold, v.values())),
        f"a mapping from names to values, such as '{{name: …}}', each {item.words}",
        item.whole,
    )


def optional(values: Values) -> Values:
    """The same, or null."""
    return Values(lambda v: v is None or values.hold(v), f"{values.words}, or null", values.whole)


def one_or_per_cost(values: Values) -> Values:
    """One value for all costs, or a list with one for each."""
    several = list_of(values, longest=1000)
    return Values(lambda v: values.hold(v) or several.hold(v), f"{values.words}, or a list of them")


boolean = Values(lambda value: isinstance(value, bool), "true or false")
text = Values(_is_text, "a text that is not empty")
anything = Values(lambda value: True, "anything")
folder_name = Values(lambda v: _is_text(v) and "/" not in v, f"{text.words} and has no /")
component = Values(
    lambda value: isinstance(value, Mapping) and _is_text(value.get("_target_")),
    "a part with a _target_, as the files in conf/ have it",
)
SHARE = number(0, 1)
POSITIVE = number(0, above=True)
NOT_NEGATIVE = number(0)
