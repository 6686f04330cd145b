"""Options of the commands but ``train``, and how these commands run.

Options are written ``key=value`` in Hydra's grammar, as in training. They are the fields of a
dataclass: pydantic checks them by their annotations, and their help texts make the command's help.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NoReturn,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from safe_rl.checks import SettingError
from safe_rl.files import print_line, printable
from safe_rl.naming import did_you_mean

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options", bound="DataclassInstance")
_FORMAT = warnings.formatwarning
_EXPECTED = (ValueError, OSError, RuntimeError, ImportError, MemoryError, OmegaConfBaseException)


def read_options(words: Iterable[str], schema: type[Options]) -> Options:
    """Read options from words ``key=value``; nested keys have dots.

    Raises:
        SettingError: If a word is no option of the dataclass, or has a value that its annotation
            does not allow.

    Examples:
        >>> from safe_rl.evaluation import EvaluationOptions
        >>> read_options(["episodes=1_000", "env.hazards_num=3"], EvaluationOptions).env
        {'hazards_num': 3}
    """
    kinds = get_type_hints(schema, include_extras=True)
    given: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals:
            raise SettingError(f"'{word}' is not an option: they are written key=value.")
        # texts are taken literally: the grammar would change `off` and `007`, and refuse `it's`
        is_text = _is_text(kinds.get(key)) and text[:1] not in ("'", '"') and text != "null"
        try:
            given[key] = text if is_text else OverridesParser.create().parse_override(word).value()
        except HydraException as error:
            raise SettingError(unreadable(word, error)) from None
    return make_options(given, schema)


def make_options(given: Mapping[str, Any], schema: type[Options]) -> Options:
    """Make options of keys, which may have dots, and values; errors as of `read_options`."""
    kinds = get_type_hints(schema, include_extras=True)
    read = OmegaConf.create()
    for key, value in given.items():
        name = key.partition(".")[0]
        if name not in kinds:
            raise SettingError(
                f"Unknown option '{name}'.{did_you_mean(name, kinds)} "
                f"Options are: {', '.join(map(_shown, fields(schema)))}."
            )
        OmegaConf.update(read, key, _plain(value), force_add=True)
    settings: Any = OmegaConf.to_container(read)
    return schema(**settings)


def _is_text(kind: Any) -> bool:
    """Whether an annotation is that of a text, or of a text or null."""
    if get_origin(kind) is Literal:
        return isinstance(get_args(kind)[0], str)
    inner = get_args(kind) if get_origin(kind) in (Annotated, Union, UnionType) else ()
    return kind is str or any(map(_is_text, inner))


def unreadable(word: str, error: Exception) -> str:
    """A message that Hydra's grammar cannot read a word, and how to write it."""
    return f"'{word}' cannot be read: {first_line(error)}.{_hint_of_grammar(word)}"


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or the name of its class."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _hint_of_grammar(text: str) -> str:
    """How to write what Hydra's grammar could not read."""
    if "=" not in text:
        return " A setting is written key=value, such as env=PointGoal1."
    if re.search(r"\{\s*['\"]", text):
        return " Names within braces have no quotes: '{cost: 10}'."
    if text.count("{") != text.count("}"):
        return " Put values with spaces in quotes: cost_limits='{cost: 10}'."
    if re.search(r"[^\x20-\x7e]|[ \[\](){}$,=]", text.partition("=")[2]):
        key, _, value = text.partition("=")
        if value[:1] in ("{", "["):
            return " Within it, texts with such characters need quotes: \"labels={a: 'A (b)'}\"."
        return f" A text with such characters needs quotes within quotes: \"{key}='{value}'\"."
    return ""


def _plain(value: Any) -> Any:
    """A value with plain containers and numbers, as a command line has them."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    value = value.tolist() if hasattr(value, "tolist") else value  # of NumPy or torch
    return str(value) if isinstance(value, Path) else value


def take_word(name: str, words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split words into the values of all ``name=value``, and the other words.

    Quotes of Hydra's grammar around a value are taken off.
    """
    given = [word for word in words if word.lstrip("+").startswith(f"{name}=")]
    others = [word for word in words if word not in given]
    values = (word.partition("=")[2] for word in given)
    return [re.sub(r"""^(['"])(.*)\1$""", r"\2", value) for value in values], others


def split_imports(words: Sequence[str]) -> tuple[list[str] | None, list[str]]:
    """Separate the modules of ``import=``, repeated or a list, from the other words.

    The modules are None if ``import=`` is not given.
    """
    given, others = take_word("import", words)
    modules = [name.strip() for text in given for name in text.strip("[]").split(",")]
    return (list(dict.fromkeys(filter(None, modules))) if given else None), others


def _shown(field: Field[Any]) -> str:
    return f"{field.name}.…" if field.default is MISSING else field.name


def usage(command: str, schema: type[DataclassInstance]) -> str:
    """The help of a command: how it is called, its options, their defaults and meanings."""
    lines = [f"usage: {command} [option=value ...]", ""]
    for field in fields(schema):
        default = "null" if field.default is None else str(field.default).lower()
        shown = _shown(field) if field.default is MISSING else f"{field.name}={default}"
        lines.append(f"  {shown:<24} {field.metadata['help']}")
    lines.append(f"  {'import=…':<24} a module or file of yours to import before; may be repeated")
    return "\n".join(lines)


def run_command(
    work: Callable[[list[str], Any, list[str] | None], int],
    arguments: Sequence[str] | None,
    call: str,
    schema: type[DataclassInstance],
) -> int:
    """Read the arguments of a command, and run it or print its help; return its exit status.

    An error is printed as one line; ``HYDRA_FULL_ERROR=1`` shows the traceback instead.

    Args:
        work: Function of the positional arguments, the options, and the modules of ``import=`` or
            None; it returns the exit status.
        arguments: The arguments; None: those of the process.
        call: How it is called, such as ``safe-rl evaluate RUN_DIR``; the words after the second
            are its positional arguments.
        schema: Dataclass of its options.
    """
    keep_streams()
    words = sys.argv[1:] if arguments is None else list(arguments)
    is_help = words[:1] in (["-h"], ["--help"])
    modules, words = split_imports(words)
    number = len(call.split()) - 2
    if is_help or len(words) < number:
        print_line(usage(call, schema))
        return 0 if is_help else 2
    try:
        return work(words[:number], read_options(words[number:], schema), modules)
    except _EXPECTED as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        print(f"error: {printable(str(error) or type(error).__name__)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        end_by_interrupt()


def keep_streams() -> None:
    """Let the command print, whatever its streams are.

    A stream that is closed takes what is written, and characters that the encoding lacks, such as ≤
    in ASCII, are escaped: neither may end a run or change the exit status. Warnings, which may
    quote files of others, are shown without control characters.
    """
    logging.raiseExceptions = False  # Hydra's log into a closed pipe, as of `--info | head`
    warnings.formatwarning = lambda *parts, **names: printable(_FORMAT(*parts, **names))
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def end_by_interrupt() -> NoReturn:
    """Say that Ctrl-C was pressed, and end by its signal: a shell's loop over commands ends too."""
    print("Interrupted.", file=sys.stderr)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGINT)
    raise KeyboardInterrupt
