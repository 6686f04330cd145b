"""What a key may hold: kinds of values, each with the words that say so."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_rl.ranges import Values, is_number, is_text

__all__ = [
    *("NOT_NEGATIVE", "POSITIVE", "SHARE", "Values", "anything", "boolean", "choice", "component"),
    *("count", "folder_name", "list_of", "mapping_of", "number", "optional"),
    "text",
]


def number(
    lowest: float = -1e9, highest: float = 1e9, *, above: bool = False, below: bool = False
) -> Values:
    """Finite numbers between two bounds; ``above`` and ``below`` leave the bounds themselves out.

    The default bounds keep a number within what float32 can square.
    """
    low = f"above {lowest:g}" if above else f"from {lowest:g}"
    high = f"below {highest:g}" if below else f"{'at most' if above else 'to'} {highest:g}"

    def hold(value: Any) -> bool:
        if not is_number(value) or not lowest <= value <= highest:
            return False
        return not (above and value == lowest) and not (below and value == highest)

    join = " and " if above or below else " "
    return Values(hold, f"a number {low}{join}{high}")


def count(lowest: int = 1, highest: int = 10**15) -> Values:
    """Whole numbers between two bounds."""

    def hold(value: Any) -> bool:
        return is_number(value) and lowest <= value <= highest and value == int(value)

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
        lambda v: isinstance(v, dict) and all(map(is_text, v)) and all(map(item.hold, v.values())),
        f"a mapping from names to values, such as '{{name: …}}', each {item.words}",
        item.whole,
    )


def optional(values: Values) -> Values:
    """The same, or null."""
    return Values(lambda v: v is None or values.hold(v), f"{values.words}, or null", values.whole)


boolean = Values(lambda value: isinstance(value, bool), "true or false")
text = Values(is_text, "a text that is not empty")
anything = Values(lambda value: True, "anything")
folder_name = Values(lambda v: is_text(v) and "/" not in v, f"{text.words} and has no /")
component = Values(
    lambda value: isinstance(value, Mapping) and is_text(value.get("_target_")),
    "a part with a _target_, as the files in conf/ have it",
)
SHARE = number(0, 1)
POSITIVE = number(0, above=True)
NOT_NEGATIVE = number(0)
