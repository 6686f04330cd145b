"""From overrides to the configuration of a new run, checked before anything is written."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.types import IntervalSweep, Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from safe_rl.cli.grammar import CommandLineError, parse
from safe_rl.cli.schema import KEYS, check_settings, plain
from safe_rl.cli.suggestions import (
    CONF,
    GIVEN_WHOLE,
    Options,
    explain,
    no_choice,
    unknown_key,
    unread_by,
)
from safe_rl.envs import store_configs
from safe_rl.naming import did_you_mean

__all__ = ["CONF", "check_once", "check_read", "compose_jobs", "hydras_own", "resolving"]

_ONE_EACH = ("env", "algo", "preset", "model", "risk", "collector", "logger", "lagrangian")


def compose_jobs(
    texts: Sequence[str],
    *,
    sweep: bool = False,
    shown: bool = False,
    folder: Path = CONF,
    name: str = "config",
) -> list[DictConfig]:
    """Compose what overrides ask for, and check it.

    Args:
        texts: The overrides.
        sweep: Whether they may have several values each. Every value is checked once, with the
            first of the other values.
        shown: Whether the configuration is only shown: it may hold any values.
        folder: Folder of the configurations; ``hydra.searchpath`` adds others.
        name: Of the main file there.

    Returns:
        Configurations with Hydra's own node: one, or of a sweep those that were checked.

    Raises:
        CommandLineError: For a name that does not exist or is not read; right ones are named.
        SettingError: For a value that a run cannot have.
        ConfigError: For a value that the environment cannot have.

    Examples:
        >>> compose_jobs(["env=CarGoal1", "seed=3"])[0].seed
        3
    """
    store_configs()
    overrides = [parse(text) for text in texts]
    check_once(overrides)
    with _hydra(folder) as loader:
        options = partial(_options, loader, name, texts)
        _check_choices(overrides, options)
        jobs = list(_jobs(overrides)) if sweep else [list(texts)]
        configs = [_compose(job, name, options) for job in jobs]
    for config in [] if shown else configs:
        _check_package(config)
        check_read(overrides, config)
        _check_values(config, overrides)
    return configs


def hydras_own(texts: Sequence[str] = ()) -> DictConfig:
    """Hydra's own node with some overrides of it."""
    with _hydra(CONF):
        return compose("config", list(texts), return_hydra_config=True).hydra


@contextmanager
def resolving(config: DictConfig) -> Iterator[None]:
    """Let ``${hydra:…}`` find Hydra's node of a configuration."""
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)
    try:
        yield
    finally:
        HydraConfig.instance().cfg = before


@contextmanager
def _hydra(folder: Path) -> Iterator[ConfigLoader]:
    """Hydra on a folder; whoever has initialised it elsewhere finds it as it was."""
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(folder.absolute()), job_name="train", version_base="1.3"):
            yield GlobalHydra.instance().config_loader()
    finally:
        GlobalHydra.instance().hydra = before


def _options(loader: ConfigLoader, name: str, texts: Sequence[str], group: str) -> list[str]:
    """Names of the files in a group, also in the folders that overrides add."""
    searched = [text for text in texts if text.startswith("hydra.searchpath=")]
    return loader.get_group_options(group, ObjectType.CONFIG, name, searched)


def _compose(texts: list[str], name: str, options: Options) -> DictConfig:
    try:
        return compose(name, texts, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError, OSError) as error:
        key = re.match(r"Could not override '([^']+)'", str(error))
        head = f"{key[1]}=" if key else ""
        given = next((text for text in texts if head and text.lstrip("+").startswith(head)), None)
        if key is None or given is None:
            raise CommandLineError(explain(error, texts, options)) from None
        # with all that is right, for what refers to it: the name of env=gymnasium is its env.id
        values = plain(_compose([text for text in texts if text != given], name, options))
        inner = re.search(r"full_key: (\S+)", str(error.__cause__))
        section, _, last = inner[1].rpartition(".") if inner else ("", "", "")
        if section and f"{section}.".startswith(f"{key[1]}."):
            known = OmegaConf.select(OmegaConf.create(values), section) or {}
            raise CommandLineError(
                f"'{given}': '{section}' has no '{last}'.{did_you_mean(last, map(str, known))} "
                f"A key that it lacks is added as +{section}.{last}=…"
            ) from None
        raise CommandLineError(unknown_key(given, key[1], values)) from None


def _jobs(overrides: Sequence[Override]) -> Iterator[list[str]]:
    """Overrides of jobs in which every value of a sweep occurs."""
    values = [_sweep_lines(override) for override in overrides]
    first = [of_one[0] for of_one in values]
    yield first
    for place, of_one in enumerate(values):
        yield from ([*first[:place], value, *first[place + 1 :]] for value in of_one[1:])


def _sweep_lines(override: Override) -> list[str]:
    """An override with each of its values; of an interval, from which sweepers draw, its ends."""
    value, key = override.value(), override.get_key_element()
    if isinstance(value, IntervalSweep):
        return [f"{key}={value.start}", f"{key}={value.end}"]
    if override.is_discrete_sweep():
        return [f"{key}={item}" for item in override.sweep_string_iterator()]
    return [str(override.input_line)]


def check_once(overrides: Sequence[Override]) -> None:
    """Refuse keys that are given twice, and parts of mappings that are given as a whole."""
    given: dict[str, list[str]] = {}
    for override in overrides:
        key, line = override.key_or_group, str(override.input_line)
        if not override.is_delete():
            given.setdefault("@".join(filter(None, (key, override.package))), []).append(line)
        for section, what in GIVEN_WHOLE.items():
            name = key.removeprefix(f"{section}.")
            if name != key:
                raise CommandLineError(
                    f"'{line}': {what} are given all at once, as "
                    f"{section}='{{{name}: {override.get_value_element_as_str()}}}'."
                )
    for key, lines in given.items():
        if lines[1:]:
            raise CommandLineError(f"'{key}' is given more than once: {', '.join(lines)}.")


def _check_choices(overrides: Sequence[Override], options: Options) -> None:
    """Check what is chosen of groups, as far as Hydra's own words would not help."""
    for override in overrides:
        group, value, line = override.key_or_group, override.value(), override.input_line
        if override.is_delete() or override.is_sweep_override() or not (known := options(group)):
            continue
        if isinstance(value, list) and value and group in _ONE_EACH:
            raise CommandLineError(
                f"'{line}': a run has one {group}; for a run with each of them: "
                f"-m {group}={','.join(map(str, value))}"
            )
        if value in ("", None) or isinstance(value, bool):
            name = override.get_value_element_as_str()
            raise CommandLineError(f"'{line}': {no_choice(group, name, known)}")


def _check_package(config: DictConfig) -> None:
    """An algorithm's file that does not say so ends up below ``algo``, with all its keys."""
    own = ("name", "_target_", "constrained")
    misplaced = [str(key) for key in config.get("algo") or () if key in config and key not in own]
    if misplaced:
        raise CommandLineError(
            f"algo={config.hydra.runtime.choices.get('algo')}: {', '.join(misplaced)} would stand "
            "below algo: its file has to begin with the line '# @package _global_'."
        )


def check_read(overrides: Sequence[Override], config: DictConfig) -> None:
    """Refuse keys that a configuration holds and its algorithm does not read."""
    algo = config.get("algo") or {}
    refused = unread_by(algo)
    for override in overrides:
        key = override.key_or_group.replace("/", ".")
        for unread, reason in refused.items():
            path, _, choice = unread.partition("=")
            is_chosen = not choice or OmegaConf.select(config, path) == choice
            if is_chosen and f"{key}.".startswith(f"{path}."):
                verb = "has no" if choice else "does not read"
                raise CommandLineError(
                    f"'{override.input_line}': algo={algo.get('name')} {verb} '{unread}'. {reason}"
                )


def _check_values(config: DictConfig, overrides: Sequence[Override]) -> None:
    try:
        with resolving(config):
            OmegaConf.select(config, "hydra.run.dir")  # which names what every run has
            check_settings(config)
            _check_added(overrides, config)
    except OmegaConfBaseException as error:
        words = " ".join(str(error).split())
        if missing := re.search(r"Missing mandatory value: (\S+)", words):
            words = f"{missing[1]} has to be given: {missing[1]}=…"
        raise CommandLineError(words) from None


def _check_added(overrides: Sequence[Override], config: DictConfig) -> None:
    """Refuse keys that are added at the top level, ``+key=…``, and that nothing refers to.

    Keys below sections and parts are checked with their values.
    """
    text = OmegaConf.to_yaml(config)
    for override in overrides:
        head = override.key_or_group.partition(".")[0]
        is_added = override.is_add() or override.is_force_add()
        if not is_added or head in KEYS or head not in config or "/" in override.key_or_group:
            continue
        # ${head}, ${head.key}, ${resolver:head.key}
        if not re.search(rf"\$\{{(?:[^${{}}]*[:,])?{re.escape(head)}[.,}}]", text):
            others = {key: node for key, node in plain(config).items() if key != head}
            line = str(override.input_line)
            raise CommandLineError(unknown_key(line, override.key_or_group, others))
