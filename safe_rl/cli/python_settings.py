"""Settings from Python in Hydra's grammar, and the configuration that Hydra makes of them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.composing import check_command
from safe_rl.cli.conf import CONF
from safe_rl.cli.overrides import GIVEN_WHOLE, CommandLineError
from safe_rl.cli.shorthands import expand_arguments
from safe_rl.cli.user_code import quote

__all__ = ["compose_new", "compose_resumed", "new_run", "overrides_of", "search_path"]

# mappings that are given all at once
_WHOLE = (
    *GIVEN_WHOLE,
    *("env.outside", "env.kwargs", "env.cost", "memory.prioritised", "policy_update.rates"),
)
_OF_YOUR_OWN = {
    "env": "safe_rl.envs.store_config(name, {…}) gives one to keys, and what Gymnasium has "
    "registered is 'gymnasium' with **{'env.id': …}.",
    "algo": "One of your own is a YAML, which config_dir=… finds.",
}


def new_run(
    env: Any,
    algo: Any,
    settings: Mapping[str, Any],
    folders: str | Path | Sequence[str | Path] | None,
) -> list[str]:
    """Overrides of a new run: environment and algorithm by their names, settings, YAMLs' folders.

    Raises:
        CommandLineError: If one is no name, a setting nothing that can be written, a folder not
            there.
    """
    for key, value in {"env": env, "algo": algo}.items():
        if not isinstance(value, str):
            what = " ".join(repr(value).split())[:80]
            raise CommandLineError(f"{key}={what}: it must be a name. {_OF_YOUR_OWN[key]}")
    return [f"env={env}", f"algo={algo}", *overrides_of(settings), *search_path(folders or ())]


def overrides_of(settings: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Settings in Hydra's grammar, which is nearly JSON's."""
    for name, value in settings.items():
        key = f"{prefix}{name}"
        if isinstance(value, Mapping) and key not in _WHOLE:
            yield from overrides_of(value, f"{key}.")
            continue
        try:
            yield f"{key}={_literal(value)}"
        except TypeError:
            raise CommandLineError(
                f"{key}={value!r}: a setting takes numbers, texts, lists, dictionaries and None. "
                "What is of your own is named as a _target_, or by a file that config_dir finds."
            ) from None


def _literal(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{_literal(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(map(_literal, value)) + "]"
    if isinstance(value, str | Path):
        return quote(str(value))
    # numbers and arrays of NumPy and torch are not JSON's
    return _literal(value.tolist()) if hasattr(value, "tolist") else json.dumps(value)


def search_path(folders: str | Path | Sequence[str | Path]) -> list[str]:
    """The override that lets Hydra look for YAMLs in folders, too; none for no folder.

    Raises:
        CommandLineError: If one is not there.
    """
    given = [folders] if isinstance(folders, str | Path) else folders
    found = [Path(folder).expanduser().absolute() for folder in given]
    if missing := next((folder for folder in found if not folder.is_dir()), None):
        raise CommandLineError(f"config_dir={missing}: there is no such folder.")
    paths = [f"file://{folder}" for folder in found]
    return list(overrides_of({"hydra.searchpath": paths})) if paths else []


def compose_new(overrides: Sequence[str]) -> DictConfig:
    """Configuration of a new run, with Hydra's own node.

    Raises:
        ValueError: If the command could not be given so.
    """
    with _fresh_hydra():
        check_command(overrides, CONF)
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = compose("config", overrides=list(overrides), return_hydra_config=True)
            OmegaConf.resolve(config.hydra.run)
            return config


def compose_resumed(directory: Path, overrides: Sequence[str]) -> DictConfig:
    """Configuration of the run in a folder, with what is to be different from now on.

    Raises:
        ValueError: If it is not the folder of a run, or something cannot change.
    """
    with _fresh_hydra():
        check_command(expand_arguments([f"resume={directory}", *overrides]), CONF)
        with initialize_config_dir(str(directory.expanduser().absolute()), version_base="1.3"):
            return compose("config", overrides=list(overrides))


@contextmanager
def _fresh_hydra() -> Iterator[None]:
    """Whoever has initialised Hydra finds it as it was."""
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        GlobalHydra.instance().hydra = before
