"""Command lines of ``train.py``, checked by composing what they ask for before Hydra does.

Hydra answers a name that does not exist with advice to add it, after which it has no effect, and
makes the folder of a run before the run can look at its configuration.
"""

from __future__ import annotations

import re
import tempfile
from argparse import Namespace
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_automatic_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf.errors import OmegaConfBaseException

from safe_rl.cli.overrides import (
    COMPOSING_ERRORS,
    CommandLineError,
    check_added,
    check_choices,
    check_read,
    check_whole,
    explain,
)
from safe_rl.cli.settings import check_settings
from safe_rl.runs.folder import RunFolder

__all__ = ["check_command"]

_MODULE = "safe_rl.cli.train"  # where a relative --config-path starts from, as in Hydra


def check_command(arguments: Sequence[str], conf: Path) -> None:
    """Check what a command line of ``train.py`` asks for, before anything is written.

    Of a sweep, every value is checked once, with the first of the other values. Command lines that
    only ask Hydra for help are left alone; those that show a configuration are checked for names.

    Args:
        arguments: Arguments of ``train.py``, with shorthands written out.
        conf: Folder of the configurations; ``--config-dir`` and the like add theirs.

    Raises:
        CommandLineError: For a name that does not exist or is not read; right ones are named.
        SettingError: For a value that a run cannot have.
        ConfigError: For a value that the environment cannot have.

    Examples:
        >>> check_command(["--hydra-help"], Path("conf"))
    """
    flags, unknown = get_args_parser().parse_known_args(list(arguments))
    if unknown:
        raise CommandLineError(_without_dashes(unknown[0]))
    if flags.help or flags.hydra_help or flags.shell_completion or flags.experimental_rerun:
        return
    overrides = [_parse(text) for text in flags.overrides]
    with _open_hydra(flags, overrides, conf) as hydra:
        check_choices(overrides, hydra.config_loader)
        check_whole(overrides)
        for job in _jobs(overrides) if _is_sweep(flags) else [flags.overrides]:
            config = _compose(hydra, flags.config_name or "config", job)
            if flags.cfg is None and flags.info is None:
                _check_package(config)
                check_read(overrides, config)
                _check_run(config, "hydra.sweep.dir" if _is_sweep(flags) else "hydra.run.dir")
                check_added(overrides, config)


def _without_dashes(flag: str) -> str:
    """What to write instead of a flag that Hydra does not have."""
    name, _, value = flag.lstrip("-").partition("=")
    written = f"{name.replace('-', '_')}={value or '…'}"
    return (
        f"'{flag}': there is no such flag. A key is written without dashes, {written}; "
        "'python train.py --hydra-help' names the flags."
    )


def _parse(text: str) -> Override:
    try:
        return OverridesParser.create().parse_override(text)
    except HydraException as error:
        quoted = re.search(r"\{\s*['\"]", text)
        hint = " Names within braces have no quotes: '{cost: 10}'." if quoted else ""
        raise CommandLineError(
            f"'{text}' cannot be read: {str(error).splitlines()[0]}.{hint}"
        ) from None


def _is_sweep(flags: Namespace) -> bool:
    return flags.multirun or "hydra.mode=MULTIRUN" in flags.overrides


@contextmanager
def _open_hydra(flags: Namespace, overrides: Sequence[Override], conf: Path) -> Iterator[Hydra]:
    """Hydra with the folders that the command line names."""
    path = create_automatic_config_search_path(None, _MODULE, flags.config_path or str(conf))
    schema = SearchPathQuery(provider="schema")
    if flags.config_dir is not None:
        folder = Path(flags.config_dir).absolute()
        if not folder.is_dir():
            raise CommandLineError(f"--config-dir {flags.config_dir}: there is no such folder.")
        path.prepend("command-line", f"file://{folder}", schema)
    for override in overrides:
        if override.get_key_element() == "hydra.searchpath":
            for searched in override.value():  # type: ignore[union-attr]
                path.prepend("command-line", str(searched), schema)
    hydra = Hydra.create_main_hydra2("train", path)
    try:
        yield hydra
    finally:
        GlobalHydra.instance().clear()


def _jobs(overrides: Sequence[Override]) -> Iterator[list[str]]:
    """Overrides of jobs in which every value of a sweep occurs."""
    values = [
        [f"{override.get_key_element()}={value}" for value in override.sweep_string_iterator()]
        if override.is_discrete_sweep()
        else [str(override.input_line)]
        for override in overrides
    ]
    first = [of_one[0] for of_one in values]
    yield first
    for place, of_one in enumerate(values):
        yield from ([*first[:place], value, *first[place + 1 :]] for value in of_one[1:])


def _compose(hydra: Hydra, name: str, overrides: list[str]) -> DictConfig:
    def compose(overrides: list[str]) -> DictConfig:
        return hydra.compose_config(name, overrides, RunMode.RUN)

    try:
        return compose(overrides)
    except COMPOSING_ERRORS as error:
        choices = [text for text in overrides if _chooses(text, hydra)]
        options = partial(hydra.config_loader.get_group_options, results_filter=ObjectType.CONFIG)
        raise CommandLineError(explain(error, overrides, choices, compose, options)) from None


def _chooses(override: str, hydra: Hydra) -> bool:
    """Whether an override chooses a file of a group."""
    group = override.partition("=")[0].lstrip("+").partition("@")[0]
    return bool(hydra.config_loader.get_group_options(group, ObjectType.CONFIG))


def _check_package(config: DictConfig) -> None:
    """An algorithm's file that does not say so ends up below ``algo``, with all its keys."""
    own = ("name", "_target_", "constrained")
    misplaced = [str(key) for key in config.get("algo") or () if key in config and key not in own]
    if misplaced:
        raise CommandLineError(
            f"algo={config.hydra.runtime.choices.get('algo')}: {', '.join(misplaced)} would stand "
            "below algo: its file has to begin with the line '# @package _global_'."
        )


def _check_run(config: DictConfig, folder_key: str) -> None:
    """Check a configuration with Hydra's node set up as it will be in the run."""
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)
    try:
        with read_write(config.hydra.runtime), open_dict(config.hydra.runtime):
            config.hydra.runtime.output_dir = ""
        HydraConfig.instance().set_config(config)
        folder = Path(str(OmegaConf.select(config, folder_key)))
        check_settings(config, RunFolder(folder))
        _check_writable(folder, folder_key)
    except OmegaConfBaseException as error:
        words = " ".join(str(error).split())
        if missing := re.search(r"Missing mandatory value: (\S+)", words):
            words = f"{missing[1]} has to be given: {missing[1]}=…"
        raise CommandLineError(words) from None
    finally:
        HydraConfig.instance().cfg = before


def _check_writable(folder: Path, key: str) -> None:
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise CommandLineError(
            f"{key}={folder}: nothing can be written there: {error.strerror}."
        ) from None
