"""Overrides of ``train.py`` that Hydra would refuse without naming the right one."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from safe_rl.naming import nearest

__all__ = ["CommandLineError", "check_overrides"]

# with folders of one's own, names are not only those of `conf/`
_OTHER_FOLDERS = ("--config-dir", "-cd", "--config-path", "-cp", "hydra.searchpath")


class CommandLineError(ValueError):
    """A command line that cannot be used; the message says what to write instead."""


def check_overrides(arguments: Sequence[str], conf: Path, env_keys: Collection[str]) -> None:
    """Check the names in overrides such as ``env=CarGoal1``, ``env.hazards_num=3``, ``frames=9``.

    Overrides that add or remove (``+``, ``~``), and command lines that name folders of
    configurations besides `conf/`, are left to Hydra.

    Args:
        arguments: Arguments of ``train.py``.
        conf: Folder of the configurations.
        env_keys: Configuration keys of an environment.

    Raises:
        CommandLineError: For a name that does not exist; the nearest one is named.

    Examples:
        >>> check_overrides(["env.hazards_num=3"], Path("conf"), ["hazards_num"])
    """
    overrides = [a.partition("=") for a in arguments if "=" in a and not a.startswith(("+", "~"))]
    for key, _, value in overrides:
        if key.startswith("env.") and key[4:] not in env_keys:
            _refuse(f"{key}={value}", "an environment has no key", key[4:], env_keys, "env.")
    if any(argument.startswith(_OTHER_FOLDERS) for argument in arguments):
        return
    choices, names = _choices(conf), _names(conf)
    for key, _, value in overrides:
        if key.startswith(("env.", "hydra")):
            continue
        if key.startswith("cost_limits."):
            raise CommandLineError(
                f"'{key}={value}': limits are given all at once, as "
                f"cost_limits='{{{key.partition('.')[2]}: {value}}}'."
            )
        _check_choices(key, value, choices)
        for name in re.split(r"[./@]", key):
            if name not in names:
                _refuse(f"{key}={value}", "there is no key", name, names)
    _check_multiplier(overrides, conf)


def _refuse(
    argument: str, problem: str, name: str, known: Collection[str], prefix: str = ""
) -> None:
    close = nearest(name, known)
    hint = f" Did you mean '{prefix}{close}'?" if close else ""
    raise CommandLineError(f"'{argument}': {problem} '{name}'.{hint}")


def _choices(conf: Path) -> dict[str, set[str]]:
    """What can be chosen of every group: files, and environments that are registered."""
    groups: dict[str, set[str]] = {"env": set()}
    for path in conf.glob("*/*.yaml"):
        groups.setdefault(path.parent.name, set()).add(path.stem)
    stored = ConfigStore.instance().list("env")
    groups["env"] |= {name.removesuffix(".yaml") for name in stored}
    return groups


def _check_choices(key: str, value: str, choices: Mapping[str, set[str]]) -> None:
    for name in value.split(",") if key in choices and re.fullmatch(r"[\w,]+", value) else ():
        if name not in choices[key]:
            _refuse(f"{key}={value}", f"there is no {key}", name, choices[key])


def _names(conf: Path) -> set[str]:
    """Every key and group in a folder of configurations, whatever it is in."""
    names = {"env", *(path.name for path in conf.glob("**/") if path != conf)}
    for path in conf.glob("**/*.yaml"):
        names |= set(_keys(OmegaConf.to_container(OmegaConf.load(path))))
    return names


def _keys(node: Any) -> Iterator[str]:
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield str(key)
            yield from _keys(value)


def _check_multiplier(overrides: Sequence[tuple[str, str, str]], conf: Path) -> None:
    """``lagrangian=`` chooses between multipliers, which not every algorithm has."""
    given = {key: value for key, _, value in overrides}
    if "lagrangian" not in given or "algo" not in given:
        return
    with_one = {
        path.stem
        for path in conf.glob("algo/*.yaml")
        if any(
            "/lagrangian" in entry for entry in OmegaConf.select(OmegaConf.load(path), "defaults")
        )
    }
    for name in given["algo"].split(","):
        if name not in with_one:
            raise CommandLineError(
                f"algo={name} has no multiplier: lagrangian= goes with "
                f"{' and '.join(sorted(with_one))}."
            )
