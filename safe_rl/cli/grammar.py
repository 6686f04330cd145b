"""Read, write and check ``key=value``, which all commands take; the grammar is Hydra's.

Training takes overrides of a configuration. The other commands take options: fields of a dataclass
with help texts in their metadata.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast, get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from safe_rl.naming import did_you_mean

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


def parse_options(arguments: Sequence[str], schema: type[Schema]) -> Schema:
    """Read the options of a command, ``key=value``; nested keys have dots.

    Raises:
        CommandLineError: If an option is unknown (the message names the nearest one), has no value,
            or has a value of another type than in the schema.
    """
    kinds = get_type_hints(schema)
    read = OmegaConf.create()
    for argument in arguments:
        key, equals, written = argument.partition("=")
        name = key.partition(".")[0]
        if not equals:
            raise CommandLineError(f"'{argument}' is not an option: they are written key=value.")
        if name not in kinds:
            raise CommandLineError(
                f"Unknown option '{name}'.{did_you_mean(name, kinds)} "
                f"Options are: {', '.join(kinds)}."
            )
        # texts are taken literally: the grammar would change `off` and `007`, and refuse `it's`
        is_text = kinds[name] in (str, str | None) and written[:1] not in ("'", '"')
        is_plain = is_text and written != "null"
        OmegaConf.update(read, key, written if is_plain else parse(argument).value())
    try:
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), read))  # type: ignore[return-value]
    except (OmegaConfBaseException, OverflowError) as error:
        line, _, place = str(error).partition("\n    full_key: ")
        raise CommandLineError(f"{line} (option '{place.partition(chr(10))[0]}')") from error


def take_options(given: Mapping[str, Any], schema: type[Schema]) -> Schema:
    """Read options from keyword arguments, as :func:`parse_options` reads them from texts."""
    return parse_options(list(overrides_of(given, ["variations"])), schema)


def usage(command: str, schema: type[DataclassInstance]) -> str:
    """The help of a command: how it is called, its options, their defaults and meanings."""
    lines = [f"usage: {command} [option=value ...]", ""]
    for field in fields(schema):
        default = "null" if field.default is None else str(field.default).lower()
        shown = f"{field.name}.…" if field.default is MISSING else f"{field.name}={default}"
        lines.append(f"  {shown:<24} {field.metadata['help']}")
    lines.append(f"  {'import=…':<24} a module or file of yours to import before; may be repeated")
    return "\n".join(lines)


def run_command(
    work: Callable[[list[str], Any, list[str] | None], int],
    arguments: Sequence[str] | None,
    command: str,
    schema: type[DataclassInstance],
) -> int:
    """Read the arguments of a command, and run it or print its help; return its exit status.

    An error is printed as one line; ``HYDRA_FULL_ERROR=1`` shows the traceback instead.

    Args:
        work: Function of the positional arguments, the options, and the modules of ``import=`` or
            None; it returns the exit status.
        arguments: The arguments; None: those of the process.
        command: The program, followed by its positional arguments in capitals.
        schema: Dataclass of its options.
    """
    say_interruptions()
    words = sys.argv[1:] if arguments is None else list(arguments)
    places = [word for word in command.split() if word[0].isupper()]
    is_help = words[:1] in (["-h"], ["--help"])
    try:
        modules, words = split_imports(words)
        if is_help or len(words) < len(places):
            print(usage(command, schema))
            return 0 if is_help else 2
        first, options = words[: len(places)], parse_options(words[len(places) :], schema)
        return work(first, options, modules)
    except (ValueError, OSError, RuntimeError, ImportError, OmegaConfBaseException) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        print(f"error: {error}", file=sys.stderr)
        return 1


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
