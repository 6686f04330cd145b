"""Read, write and check ``key=value``, which all commands take; the grammar is Hydra's.

Training takes overrides of a configuration; options of the other commands are in `cli/options.py`.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Schema = TypeVar("Schema", bound="DataclassInstance")


class CommandLineError(ValueError):
    """A command line that cannot be used; the message says what to write instead."""


def parse(text: str) -> Override:
    """Read one override; a `CommandLineError` says why a text is none."""
    try:
        return OverridesParser.create().parse_override(text)
    except HydraException as error:
        hint = ""
        if "=" not in text:
            hint = " A setting is written key=value, such as env=PointGoal1."
        elif re.search(r"\{\s*['\"]", text):
            hint = " Names within braces have no quotes: '{cost: 10}'."
        elif text.count("{") != text.count("}"):
            hint = " Put values with spaces in quotes: cost_limits='{cost: 10}'."
        raise CommandLineError(
            f"'{text}' cannot be read: {str(error).splitlines()[0]}.{hint}"
        ) from None


def take_word(name: str, words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split words into the values of all ``name=value``, and the other words."""
    given = [word for word in words if word.lstrip("+").startswith(f"{name}=")]
    others = [word for word in words if word not in given]
    return [word.partition("=")[2] for word in given], others


def split_imports(arguments: Sequence[str]) -> tuple[list[str] | None, list[str]]:
    """Separate ``import=``, which may be repeated or hold a list, from the other arguments.

    Returns:
        The modules, or None if ``import=`` is not given; and the other arguments.
    """
    given, others = take_word("import", arguments)
    modules: list[str] = []
    for text in given:
        is_list = text.startswith("[")
        modules += cast(list[str], parse(f"import={text}").value()) if is_list else [text]
    return (list(dict.fromkeys(modules)) if given else None), others


def overrides_of(
    settings: Mapping[str, Any], whole: Sequence[str] = (), prefix: str = ""
) -> Iterator[str]:
    """Write settings from Python as overrides; nested keys are joined by dots.

    Args:
        settings: Key -> value.
        whole: Keys whose mappings are written as one value.
        prefix: Key of ``settings`` itself, followed by a dot.

    Raises:
        CommandLineError: If a value has a type that overrides cannot express.

    Examples:
        >>> list(overrides_of({"model": {"hidden_sizes": [8]}, "cost_limits": {"cost": 3}}, ["cost_limits"]))
        ['model.hidden_sizes=[8]', 'cost_limits={cost:3}']
    """  # noqa: E501
    for name, value in settings.items():
        key = f"{prefix}{name}"
        if isinstance(value, Mapping) and key not in whole:
            yield from overrides_of(value, whole, f"{key}.")
            continue
        try:
            yield f"{key}={_written(value)}"
        except TypeError:
            raise CommandLineError(
                f"{key}={value!r}: a setting takes numbers, texts, lists, dictionaries and None. "
                "Name an object of your own as a _target_, or in a YAML file below config_dir."
            ) from None


def _written(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{_written(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(_written, value)) + "]"
    if isinstance(value, str | Path):
        return QuotedString(str(value), Quote.single).with_quotes()
    # JSON does not know numbers and arrays of NumPy and torch
    return _written(value.tolist()) if hasattr(value, "tolist") else json.dumps(value)


def say_interruptions() -> None:
    """Print one line on Ctrl-C instead of a traceback.

    The process still ends by the signal, so that a shell's loop over commands ends as well.
    """

    def say(kind: type[BaseException], *error: Any) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print("Interrupted.", file=sys.stderr)
        else:
            sys.__excepthook__(kind, *error)

    sys.excepthook = say
