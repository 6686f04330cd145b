"""The configuration of a run, checked before anything is written.

That of a new run is composed from overrides. That of a run that is continued is read from its
folder, as plain values: Hydra looks for nothing there, so what somebody else has put into a folder
cannot make code run.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import IntervalSweep, Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from safe_rl.cli.grammar import CommandLineError, overrides_of, parse, take_word
from safe_rl.cli.schema import KEYS, check_settings, plain
from safe_rl.cli.suggestions import GIVEN_WHOLE, explain, unknown_key, unread_by
from safe_rl.cli.user_code import check_imports, note_imports
from safe_rl.envs import store_configs
from safe_rl.files import CONF, read_config, read_yaml
from safe_rl.runs.folder import RunFolder
from safe_rl.runs.identity import role_of

__all__ = ["compose_jobs", "compose_resumed", "hydra_on_conf", "resolving", "search_folders"]

_ONE_EACH = ("env", "algo", "preset", "model", "risk", "collector", "logger", "lagrangian")
_MISSING = object()


def compose_jobs(
    texts: Sequence[str], *, sweep: bool = False, shown: bool = False
) -> list[DictConfig]:
    """Compose what overrides ask for, and check it.

    Args:
        texts: The overrides.
        sweep: Whether they may have several values each. Every value is checked once, with the
            first of the other values.
        shown: Whether the configuration is only shown: it may hold any values.

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
    overrides = [parse(text) for text in texts]
    _check_once(overrides)
    with hydra_on_conf():
        jobs = list(_jobs(overrides)) if sweep else [list(texts)]
        configs = [_compose(job) for job in jobs]
    for config in [] if shown else configs:
        _check_package(config)
        _check_read(overrides, config)
        _check_values(config, overrides)
    return configs


@contextmanager
def hydra_on_conf() -> Iterator[Any]:
    """Hydra on ``conf/``; whoever has initialised it elsewhere finds it as it was."""
    store_configs()
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONF), job_name="train", version_base="1.3"):
            yield GlobalHydra.instance().hydra
    finally:
        GlobalHydra.instance().hydra = before


@contextmanager
def resolving(config: DictConfig) -> Iterator[None]:
    """Let ``${hydra:…}`` find Hydra's node of a configuration."""
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)
    try:
        yield
    finally:
        HydraConfig.instance().cfg = before


def search_folders(folders: Iterable[str | Path], texts: Sequence[str]) -> list[str]:
    """Overrides by which Hydra looks for files in some folders, too.

    Raises:
        CommandLineError: If there is no such folder.
    """
    paths = [Path(folder).expanduser().absolute() for folder in folders]
    if missing := next((path for path in paths if not path.is_dir()), None):
        raise CommandLineError(f"config_dir={missing}: there is no such folder.")
    value, others = take_word("hydra.searchpath", texts)
    before = [] if value is None else parse(f"hydra.searchpath={value}").value()
    found = [*(f"file://{path}" for path in paths), *cast(list[str], before)]
    return [*others, *overrides_of({"hydra.searchpath": found} if found else {})]


def _compose(texts: list[str]) -> DictConfig:
    try:
        return compose("config", texts, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError, OSError) as error:
        wrong = re.match(r"Could not override '([^']+)'", str(error))
        given = next((t for t in texts if wrong and t.lstrip("+").startswith(f"{wrong[1]}=")), None)
        if wrong is None or given is None:
            raise CommandLineError(explain(error, texts)) from None
        # with all that is right, for what refers to it: the name of env=gymnasium is its env.id
        values = plain(_compose([text for text in texts if text != given]))
        inner = re.search(r"full_key: (\S+)", str(error.__cause__))
        if inner and inner[1].startswith(f"{wrong[1]}."):
            words = unknown_key(given, inner[1], values)
            raise CommandLineError(f"{words} A new key is added as +{inner[1]}=…") from None
        raise CommandLineError(unknown_key(given, wrong[1], values)) from None


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


def _check_once(overrides: Sequence[Override]) -> None:
    """Refuse keys that are given twice, parts of what is given as a whole, and lists of choices."""
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
        if key in _ONE_EACH and isinstance(values := override.value(), list):
            raise CommandLineError(
                f"'{line}': a run has one {key}; for a run with each of them: "
                f"-m {key}={','.join(map(str, values))}"
            )
    for key, lines in given.items():
        if lines[1:]:
            raise CommandLineError(f"'{key}' is given more than once: {', '.join(lines)}.")


def _check_package(config: DictConfig) -> None:
    """An algorithm's file that does not say so ends up below ``algo``, with all its keys."""
    own = ("name", "_target_", "constrained")
    misplaced = [str(key) for key in config.get("algo") or () if key in config and key not in own]
    if misplaced:
        raise CommandLineError(
            f"algo={config.hydra.runtime.choices.get('algo')}: {', '.join(misplaced)} would stand "
            "below algo: its file has to begin with the line '# @package _global_'."
        )


def _check_read(overrides: Sequence[Override], config: DictConfig) -> None:
    """Refuse keys that a configuration holds and its algorithm does not read."""
    algo = config.get("algo") or {}
    for override in overrides:
        key = override.key_or_group.replace("/", ".")
        for unread, reason in unread_by(algo).items():
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
    """Refuse keys that are added at the top level, ``+key=…``, and that nothing refers to."""
    text = OmegaConf.to_yaml(config)
    for override in overrides:
        key, head = override.key_or_group, override.key_or_group.partition(".")[0]
        is_added = (override.is_add() or override.is_force_add()) and head in config
        # ${head}, ${head.key}, ${resolver:head.key}
        if is_added and head not in KEYS and not re.search(rf"[{{:,]{re.escape(head)}[.,}}]", text):
            others = {name: node for name, node in plain(config).items() if name != head}
            raise CommandLineError(unknown_key(str(override.input_line), key, others))


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
    _check_once(overrides)
    _refuse_foreign_cluster(config, overrides, run.config)
    try:
        said = list(read_yaml(run.overrides))
    except (OSError, ValueError, TypeError):
        said = []
    changes = [o for o in overrides if not _is_held(o, config, directory, said)]
    for override in changes:
        _check_may_change(override, config, directory)
        if not override.is_hydra_override():
            OmegaConf.update(config, override.key_or_group, override.value(), force_add=True)
    _check_read(changes, config)
    check_settings(config, run)
    return config


def _is_held(override: Override, config: DictConfig, directory: Path, said: Sequence[Any]) -> bool:
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
