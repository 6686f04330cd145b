"""Checks of a run's configuration, before anything is built or written."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from typing import Any, NamedTuple, TypedDict

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from safe_rl.cli.keys import KEYS
from safe_rl.cli.robots import robot_of
from safe_rl.envs import complete_env
from safe_rl.evaluation.settings import check_device
from safe_rl.extras import check_extra
from safe_rl.naming import did_you_mean
from safe_rl.parameters import Parameter, SettingError, parameters_of
from safe_rl.ranges import Text
from safe_rl.runs.folder import RunFolder
from safe_rl.targets import accepted_names, constructors, locate, takes_any

__all__ = ["SettingError", "check_settings", "keys_of_part", "optional_keys", "plain"]

_MISSING = object()
_SECTIONS = (
    *("algo", "certificate", "checkpoint", "collector", "critics", "dataset", "evaluation"),
    *("exploration", "logger", "model"),
)


class _Node(TypedDict, total=False):
    """Keys of any part that are Hydra's.

    Attributes:
        _target_: What is built.
        _partial_: Whether it is called later with more arguments.
    """

    _target_: Text | None
    _partial_: bool


_OF_HYDRA = parameters_of(_Node)


class _Entry(NamedTuple):
    """A key of a configuration that has a row."""

    path: str
    row: Parameter
    value: Any


class _Part(NamedTuple):
    """A node that something is built from."""

    path: str
    node: Mapping[str, Any]
    found: Callable[..., Any]


def check_settings(config: DictConfig, folder: RunFolder | None = None) -> None:
    """Check every key of a configuration: the run's by `KEYS`, those of parts by their signatures.

    Custom parts are checked like the package's. Whole numbers that are written as 3e5 become
    integers.

    Args:
        config: Configuration as composed from ``conf/``.
        folder: That of a run that is continued, if it is; its robot is checked.

    Raises:
        SettingError: For the first key that does not exist or holds what it cannot.
        TargetError: For a part that cannot be built.
        ConfigError: For one of the environment's.
    """
    values = plain(config)
    for entry in chain(_entries_of_keys(values), _entries_of_parts(values)):
        entry.row.check(entry.path, entry.value)
        if entry.row.values.whole:
            OmegaConf.update(config, entry.path, _whole(entry.value), merge=False)
    for part in _parts(values):
        try:
            check_extra(part.found)
        except ModuleNotFoundError as error:
            raise SettingError(f"{part.path}: {error}") from None
    for path, known in _unread_keys(values):
        raise SettingError(f"{path}: nothing reads this key.{did_you_mean(path, known)}")
    try:
        check_device(values["device"])
    except ValueError as error:
        raise SettingError(str(error)) from None
    _check_collector(values["collector"])
    complete_env(values["env"] if folder is None else robot_of(folder, values["env"])[0])


def plain(config: DictConfig) -> dict[str, Any]:
    """A configuration as dictionaries and lists, without Hydra's own node.

    Raises:
        SettingError: If a value refers to one that is not there.
    """
    try:
        if "hydra" in config:
            config = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        values = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:
        raise SettingError(f"{error.full_key}: {str(error).partition(chr(10))[0]}") from None
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def optional_keys(values: Mapping[str, Any]) -> Iterator[str]:
    """Full paths of what a configuration does not hold and its parts would read."""
    for path, node, found in _parts(values):
        yield from (f"{path}.{name}" for name in keys_of_part(found) if name not in node)


def keys_of_part(found: Callable[..., Any]) -> dict[str, Parameter]:
    """Hyper-parameters of what a configuration can build, by name."""
    return {name: row for name, row in _rows(found).items() if row.is_described}


def _unread_keys(values: Mapping[str, Any]) -> Iterator[tuple[str, list[str]]]:
    """Keys in sections and parts of a configuration that nothing reads, and those that are read.

    Keys of environments and those outside of all sections are not among them.
    """
    for section in _SECTIONS:
        node = values.get(section)
        if isinstance(node, Mapping) and node.get("_target_") is None:
            known = [path for path in KEYS if path.startswith(f"{section}.")]
            yield from _others(section, node, known)
    for path, node, found in _parts(values):
        names = _names(found)
        if names is not None:
            yield from _others(path, node, [f"{path}.{name}" for name in names])


def _others(
    path: str, node: Mapping[str, Any], known: list[str]
) -> Iterator[tuple[str, list[str]]]:
    paths = [f"{path}.{name}" for name in node if not str(name).startswith("_")]
    yield from ((path, known) for path in paths if path not in known)


def _entries_of_keys(values: Mapping[str, Any]) -> Iterator[_Entry]:
    for path, row in KEYS.items():
        above, _, name = path.rpartition(".")
        section = _at(values, above)
        if section is None or (section is _MISSING and not KEYS[above].is_required):
            continue  # switched off, or of another kind of algorithm
        value = section.get(name, _MISSING) if isinstance(section, Mapping) else _MISSING
        is_part = path.startswith("collector.") and values["collector"].get("_target_")
        if value is not _MISSING and not is_part:
            yield _Entry(path, row, value)
        elif value is _MISSING and row.is_required:
            raise SettingError(f"{path} is missing: {row.meaning}.")


def _at(values: Mapping[str, Any], path: str) -> Any:
    """The value at a dotted path; the whole for an empty one."""
    node: Any = values
    for name in path.split(".") if path else ():
        node = node.get(name, _MISSING) if isinstance(node, Mapping) else node
    return node


def _entries_of_parts(values: Mapping[str, Any]) -> Iterator[_Entry]:
    for path, node, found in _parts(values):
        rows = {**_OF_HYDRA, **_rows(found)}
        for name in node:
            if name in rows:
                yield _Entry(f"{path}.{name}", rows[name], node[name])


def _parts(values: Mapping[str, Any], prefix: str = "") -> Iterator[_Part]:
    """What a configuration builds outside the environment, each part before those within it."""
    for name, node in values.items():
        if isinstance(node, Mapping) and (prefix or name not in ("env", "algo")):
            path = f"{prefix}{name}"
            target = node.get("_target_")
            if target is not None:
                _OF_HYDRA["_target_"].check(f"{path}._target_", target)
                yield _Part(path, node, locate(target, f"{path}._target_"))
            yield from _parts(node, f"{path}.")


def _rows(found: Callable[..., Any]) -> Mapping[str, Parameter]:
    """What the signature of a part says of its arguments; nothing if it has none to read."""
    try:
        return parameters_of(found)
    except (AttributeError, TypeError, ValueError):
        return {}


def _names(found: Callable[..., Any]) -> list[str] | None:
    """Arguments that a part takes; None if it takes any, or cannot be known."""
    try:
        known = constructors(found)
        ours = all(function.__module__.startswith("safe_rl.") for function in known)
        # the package's constructors hand on all that they do not name, others may use it
        last = known[-1] if ours else known[0]
        return None if takes_any(last) else sorted(accepted_names(found))
    except (AttributeError, TypeError, ValueError):
        return None


def _whole(value: Any) -> Any:
    if isinstance(value, list):
        return [_whole(item) for item in value]
    return int(value) if isinstance(value, float) else value


def _check_collector(node: Mapping[str, Any]) -> None:
    number = node["num_collectors"]
    if node.get("_target_") is None and number != 1:
        raise SettingError(
            f"collector.num_collectors={number}: collector=local is one process; for more use "
            "collector=process or collector=ray."
        )
