"""The configuration of a run that is continued: its own, with what is to be different from now on.

It is read from the run's folder as plain values. Hydra looks for nothing there: what somebody else
has put into a folder cannot make code run.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.composing import check_once, check_read
from safe_rl.cli.grammar import CommandLineError, parse
from safe_rl.cli.schema import check_settings, plain
from safe_rl.cli.suggestions import unknown_key
from safe_rl.cli.user_code import check_imports, note_imports
from safe_rl.files import read_config, read_yaml
from safe_rl.runs.folder import RunFolder
from safe_rl.runs.identity import role_of

__all__ = ["compose_resumed"]

_MISSING = object()


def compose_resumed(
    directory: Path, texts: Iterable[str], modules: Sequence[str] | None = None
) -> DictConfig:
    """The configuration of the run in a folder, with what is to be different from now on.

    What a run has already may be said again.

    Args:
        directory: The folder.
        texts: Overrides of what is to be different.
        modules: The user's modules; None if none are named.

    Raises:
        CommandLineError: If it is not the folder of a run, or something cannot change.
        SettingError: For a value that a run cannot have.
    """
    run = RunFolder(directory)
    try:
        run.check_is_run()
        config = OmegaConf.create(read_config(run.config))
    except (OSError, ValueError) as error:
        raise CommandLineError(f"resume={directory}: {error}") from None
    check_imports(config, modules, directory)
    overrides = [parse(text) for text in (*texts, *note_imports(modules))]
    check_once(overrides)
    _refuse_foreign_cluster(config, overrides, run.config)
    said = _said_before(run)
    changes = [o for o in overrides if not _is_held(o, config, directory, said)]
    for override in changes:
        _check_may_change(override, config, directory)
        if not override.is_hydra_override():
            OmegaConf.update(config, override.key_or_group, override.value(), force_add=True)
    check_read(changes, config)
    check_settings(config, run)
    return config


def _said_before(run: RunFolder) -> list[str]:
    """Overrides with which a run was begun, of which nothing is taken: they are compared."""
    try:
        said = read_yaml(run.overrides)
    except (OSError, ValueError):
        return []
    return [str(text) for text in said] if isinstance(said, list) else []


def _is_held(override: Override, config: DictConfig, directory: Path, said: Sequence[str]) -> bool:
    """Whether a run is told what it has already: a value, a name, a choice of its beginning."""
    key, value = override.key_or_group, override.value()
    if key == "hydra.run.dir":
        return Path(str(value)).expanduser().resolve() == directory.expanduser().resolve()
    if override.input_line in said and not _is_number(override, config):
        return True
    there = OmegaConf.select(config, key, default=_MISSING) if "/" not in key else _MISSING
    name = there.get("name", _MISSING) if isinstance(there, DictConfig) else there
    return not override.is_delete() and value in (name, there)


def _is_number(override: Override, config: DictConfig) -> bool:
    """Whether an override is of a value that may change, and chooses and deletes nothing."""
    key = override.key_or_group
    is_choice = "/" in key or isinstance(config.get(key), DictConfig)
    return role_of(key).may_change and not (is_choice or override.is_delete())


def _check_may_change(override: Override, config: DictConfig, directory: Path) -> None:
    key, line = override.key_or_group, override.input_line
    is_plain = override.get_key_element() == key and not override.is_hydra_override()
    if is_plain and "/" not in key and OmegaConf.select(config, key, default=_MISSING) is _MISSING:
        raise CommandLineError(unknown_key(str(line), key, plain(config)))
    if override.is_sweep_override():
        raise CommandLineError(f"'{line}': a run has one value of it.")
    if not _is_number(override, config):
        raise CommandLineError(
            f"'{line}' cannot change in a run that is continued. What can: its length "
            "(frames=…), what belongs to the machine (checkpoint.interval=…), and numbers "
            "below loss, limits, policy_update and the like, except those that a checkpoint "
            "brings along, such as an optimiser's lr. For a new run from trained networks use "
            f"init_from={directory}."
        )


def _refuse_foreign_cluster(config: DictConfig, overrides: Sequence[Override], path: Path) -> None:
    """What Ray is started with can make code run: only the command line says it, not a file."""
    stored = dict(OmegaConf.select(config, "collector.ray_init") or {})
    is_said = any(o.key_or_group == "collector.ray_init.address" for o in overrides)
    if stored.pop("address", None) is not None and not is_said:
        raise CommandLineError(
            f"{path} names a Ray cluster, which is not taken from a file: say again "
            "collector.ray_init.address=… (null for Ray on this machine)."
        )
    if "runtime_env" in (OmegaConf.select(config, "collector.resources") or {}):
        stored["runtime_env"] = None  # actors can be started with it, too
    if stored:
        raise CommandLineError(
            f"{path} starts Ray with {', '.join(stored)}, which could make code run: delete that "
            "there to resume."
        )
