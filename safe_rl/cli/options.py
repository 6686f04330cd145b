"""Options of the command-line tools: ``key=value``, checked against a schema by OmegaConf.

The schema is a dataclass; its fields' metadata holds the help texts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING, Any, TypeVar

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from safe_rl.naming import did_you_mean

__all__ = ["OptionError", "parse_options", "take_options", "usage"]

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Schema = TypeVar("Schema", bound="DataclassInstance")


class OptionError(ValueError):
    """An option of the command line that cannot be used; the message says what to write instead."""


def parse_options(arguments: Sequence[str], schema: type[Schema]) -> Schema:
    """Read options.

    Args:
        arguments: Texts of the form ``key=value``; values are YAML, nested keys have dots.
        schema: Dataclass with a default for every field.

    Raises:
        OptionError: For an option that is unknown (the nearest is named), without a value, or of
            another type than the schema's.

    Examples:
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Options:
        ...     episodes: int = 100
        ...     video: bool = False
        >>> parse_options(["episodes=7", "video=true"], Options)
        Options(episodes=7, video=True)
        >>> parse_options(["episode=7"], Options)
        Traceback (most recent call last):
        ...
        safe_rl.cli.options.OptionError: Unknown option 'episode'. Did you mean 'episodes'? Options are: episodes, video.
    """  # noqa: E501
    for argument in arguments:
        key, equals, _ = argument.partition("=")
        if not equals:
            raise OptionError(
                f"'{argument}' is not an option: options are written key=value, for example "
                f"{fields(schema)[0].name}=…"
            )
        _check_name(key.partition(".")[0], schema)

    def read() -> DictConfig:
        given: Any = OmegaConf.to_container(OmegaConf.from_dotlist(list(arguments)))
        return OmegaConf.create(_with_values({**given, **_texts(arguments, given, schema)}))

    return _merged(schema, read, " ".join(arguments))


def _texts(
    arguments: Sequence[str], given: Mapping[str, Any], schema: type[DataclassInstance]
) -> dict[str, str]:
    """Options that are texts as they were written, where YAML reads ``off``, ``007`` or ``1e3``."""
    names = {field.name for field in fields(schema) if isinstance(field.default, str)}
    written = dict(argument.split("=", 1) for argument in arguments)
    return {
        name: written[name]
        for name in names & written.keys()
        if not isinstance(given[name], str | None)
    }


def take_options(given: Mapping[str, Any], schema: type[Schema]) -> Schema:
    """Check keyword arguments, as :func:`parse_options` checks texts; nested keys may have dots.

    Raises:
        OptionError: For an option that is unknown, or of another type than the schema's.

    Examples:
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Options:
        ...     episodes: int = 100
        >>> take_options({"episodes": 7}, Options)
        Options(episodes=7)
    """
    for name in given:
        _check_name(name.partition(".")[0], schema)

    def read() -> DictConfig:
        read = OmegaConf.create()
        for key, value in given.items():
            OmegaConf.update(read, key, _plain(value))
        return read

    return _merged(schema, read, str(dict(given)))


def _with_values(value: Any) -> Any:
    """What ``train.py`` takes for a mapping: of ``{cost:20}`` YAML makes a name without a value.

    Examples:
        >>> _with_values({"cost_limits": {"cost:20": None}})
        {'cost_limits': {'cost': 20}}
    """
    if not isinstance(value, Mapping):
        return value
    pairs = {}
    for key, item in value.items():
        name, _, text = str(key).partition(":")
        if text and item is None:
            pairs[name] = yaml.safe_load(text)
        else:
            pairs[key] = _with_values(item)
    return pairs


def _plain(value: Any) -> Any:
    """Numbers and arrays of NumPy and torch are none of OmegaConf's."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value


def _check_name(name: str, schema: type[DataclassInstance]) -> None:
    known = [field.name for field in fields(schema)]
    if name not in known:
        raise OptionError(
            f"Unknown option '{name}'.{did_you_mean(name, known)} Options are: {', '.join(known)}."
        )


def _merged(schema: type[Schema], read: Callable[[], DictConfig], shown: str) -> Schema:
    try:
        given = read()
        _check_kinds(given, schema)
        merged = OmegaConf.merge(OmegaConf.structured(schema), given)
        return OmegaConf.to_object(merged)  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        raise OptionError(f"{str(error).splitlines()[0]} (option '{error.full_key}')") from error
    except yaml.YAMLError as error:
        words = " ".join(str(error).split())
        raise OptionError(f"{shown}: a value cannot be read: {words}") from error


def _check_kinds(given: DictConfig, schema: type[DataclassInstance]) -> None:
    """OmegaConf takes every number for a boolean, and says of a mapping that it is a Dict."""
    for field in fields(schema):
        value = given.get(field.name)
        if field.default_factory is dict and not isinstance(value, Mapping | None):
            raise OptionError(
                f"{field.name}={value}: it takes keys with values, {field.name}.KEY=VALUE: "
                f"{field.metadata['help']}."
            )
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if isinstance(field.default, bool) and is_number:
            raise OptionError(f"{field.name}={value}: it must be true or false.")


def usage(command: str, schema: type[DataclassInstance]) -> str:
    """How a command is called: its options, their defaults and what they mean."""
    lines = [f"usage: {command} [option=value ...]", ""]
    for field in fields(schema):
        default = "null" if field.default is None else str(field.default).lower()
        shown = f"{field.name}.…" if field.default is MISSING else f"{field.name}={default}"
        lines.append(f"  {shown:<24} {field.metadata['help']}")
    lines.append(f"  {'import=…':<24} a module or file of yours to import before; may be repeated")
    return "\n".join(lines)
