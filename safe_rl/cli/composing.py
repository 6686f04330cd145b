"""Compose the configuration of a run by Hydra, and say in one line what is wrong with it.

Commands get their configuration from ``@hydra.main``; Python and tests get the same one here, from
Hydra's `compose`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from shlex import quote
from threading import RLock
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from safe_rl.cli.config import General, keys_of, unknown_key
from safe_rl.cli.folders import name_choices
from safe_rl.cli.options import first_line, unreadable
from safe_rl.envs import store_configs
from safe_rl.envs.families import hint_of_gymnasium
from safe_rl.envs.safety_gym.config import KEYS
from safe_rl.extras import hint_of_plugin
from safe_rl.files import CONF, PROGRAM
from safe_rl.naming import did_you_mean, nearest
from safe_rl.runs.identity import differences, flatten
from safe_rl.runs.run import Run
from safe_rl.trust import check_imports

_MOST_LISTED = 40
RESUMED = "resumed"
"""Name in Hydra's ConfigStore of the configuration of a run that is continued."""
COMPOSING = RLock()
"""Held while Hydra composes: its state and its ConfigStore are those of the process."""
COMPOSITION_ERRORS = (
    *(HydraException, OmegaConfBaseException, YAMLError),
    *(ValueError, AttributeError),  # Hydra's of logger=null, OmegaConf's of missing sections
)


def compose_run(
    words: Sequence[str], folders: Iterable[str | Path] = (), name: str = "config"
) -> DictConfig:
    """Compose the configuration of one run, with its node ``hydra``.

    `words` are overrides, `folders` those of ``--config-dir``, `name` is the primary configuration.

    Raises:
        ValueError: If a folder does not exist, or Hydra refuses a word or a file, in one line.

    Examples:
        >>> compose_run(["env=CarGoal1", "seed=3"]).seed
        3
    """
    store_configs()
    places = [Path(folder).expanduser().absolute() for folder in folders]
    for place in places:
        if not place.is_dir():
            raise ValueError(f"config_dir={place}: there is no such folder.")
    words = [*_searched(places), *words]
    try:
        config = _compose(words, name)
        name_choices(config, config.hydra)
    except COMPOSITION_ERRORS as error:
        raise ValueError(explain(error, [f"--config-name={name}", *words])) from error
    return config


def _searched(folders: Iterable[str | Path]) -> list[str]:
    """The override that does what ``--config-dir`` does for a command, if there are folders."""
    paths = [f"file://{Path(folder).absolute()}" for folder in folders]
    return [*overrides_of({"hydra.searchpath": paths} if paths else {})]


def _compose(words: Sequence[str], name: str = "config") -> DictConfig:
    # an application of the user's may be on Hydra too, and call `safe_rl.train`
    with COMPOSING:
        outside = GlobalHydra.instance().hydra
        GlobalHydra.instance().clear()
        try:
            with initialize_config_dir(str(CONF), job_name="train", version_base="1.3"):
                return compose(name, list(words), return_hydra_config=True)
        finally:
            GlobalHydra.instance().hydra = outside


def overrides_of(settings: Mapping[str, Any]) -> Iterator[str]:
    """Write settings from Python as overrides of Hydra; ValueError for a value of another type.

    Examples:
        >>> list(overrides_of({"model": {"hidden_sizes": [8]}, "seed": 3, "note": None}))
        ['model={hidden_sizes:[8]}', 'seed=3', 'note=null']
    """
    for key, value in settings.items():
        try:
            yield f"{key}={_written(value)}"
        except TypeError:
            raise ValueError(
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


def explain(error: Exception, words: Sequence[str]) -> str:
    """What is wrong with a command, in one line; an AttributeError of another cause is raised."""
    if isinstance(error, OverrideParseException):
        return unreadable(str(error.override), error)
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return _unknown_choice(error)
    if str(error).startswith("Config group override must be"):
        return _unnamed_choice(words) or str(error)
    if str(error).startswith("Ambiguous value for argument 'env="):
        return "env=A,B and slate=… are several environments: add -m."
    if type(error) is AttributeError:
        missing = re.search(r"full_key: (\w+)\.\S+\s+object_type=General", str(error))
        if missing is None:
            raise error
        return _absent(missing[1])
    unknown = re.match(r"Could not override '([^']+)'\.", str(error))
    if isinstance(error, ConfigCompositionException) and unknown:
        is_group = "No match in the defaults list" in str(error)
        is_new = f"--config-name={RESUMED}" not in words
        if is_group and is_new and unknown[1] not in General.__annotations__:
            return f"{unknown[1]}: nothing is chosen that it could replace; add it, +{unknown[1]}=…"
        inner = re.search(r"full_key: (\S+)", str(error.__cause__))
        return _unknown_key(inner[1] if inner else unknown[1], unknown[1], words)
    foreign = re.search(r"(?s)In '(\S+)': .*Key '\S+' not in '(\S+)'\s+full_key: (\S+)", str(error))
    if foreign:
        return _foreign_key(*foreign.groups())
    if "Interpolation key 'env.name' not found" in str(error):
        return "env: the file of an environment needs a line 'name: …'."
    taken = re.match(r"'(\w+)/(\S+)' is validated against ConfigStore schema", str(error))
    if taken:
        return f"{taken[1]}={taken[2]}: the package has one of this name. Rename your file."
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else None
    absent = re.search(r"Missing mandatory value: (\S+)", str(cause or error))
    if absent and absent[1] in General.__annotations__:
        return _absent(absent[1])
    if cause is not None and str(error) != str(cause):
        return f"{first_line(error)}: {first_line(cause)}"
    if absent:
        return f"{absent[1]} has to be given: {absent[1]}=…"
    return " ".join(str(error).split())


def _unknown_choice(error: MissingConfigException) -> str:
    """A message about a file that does not exist, such as ``env=PointGaol1``."""
    group, _, name = str(error.missing_cfg_file).rpartition("/")
    known = list(error.options or ())
    if not known:
        known = sorted(file.stem for file in (CONF / group).glob("*.yaml"))
    file = re.match(r"In '(?!config)([^']+)'", str(error))
    place = f"{file[1]}.yaml: " if file else ""
    if file and not known:
        return f"{place}there is no {group}. In 'defaults' write /{Path(group).name}: {name}."
    if name in known:
        return f"{place}there is no '{name}': --config-path replaces conf/, --config-dir adds."
    all_of_them = f"There are {', '.join(known)}"
    listed = all_of_them if len(known) <= _MOST_LISTED else f"'{PROGRAM} --help' names all"
    hint = hint_of_gymnasium(name) if group == "env" else hint_of_plugin(f"{group}={name}")
    hint = hint or did_you_mean("none" if name == "null" else name, known, 0.6)
    more = f" {listed}; a file of yours needs --config-dir FOLDER, a module import=FILE.py."
    return f"{place}there is no {group} '{name}'.{hint or more}"


def _unnamed_choice(words: Sequence[str]) -> str | None:
    """A message about a choice that is no name, such as ``logger=null``."""
    for key, value in re.findall(r"^(\w+)=(null|true|false|[\d.]+)$", "\n".join(words), re.M):
        try:
            _compose([f"{key}='{value}'"])
        except MissingConfigException as error:  # it knows the names
            return _unknown_choice(error).rpartition(".yaml: ")[2]
        except COMPOSITION_ERRORS:  # no choice but a value, such as seed=3
            continue
    return None


def _absent(section: str) -> str:
    """A message about a section that the algorithm's file does not have."""
    if section == "evaluation":
        return "evaluation: give both keys at once, evaluation='{interval: 10000, episodes: 5}'."
    return f"this algorithm has no '{section}'."


def _unknown_key(key: str, given: str, words: Sequence[str]) -> str:
    """A message about a key that the configuration does not have."""
    name = RESUMED if f"--config-name={RESUMED}" in words else "config"
    if name == RESUMED and (key == "env" or (CONF / key).is_dir()):
        return f"{key}: a continued run keeps its {key}."
    if key.startswith("cost_limits."):
        if any(word.startswith("cost_limits=") for word in words):
            return f"{key}: a file has other limits. To add this one to them: +{key}=…"
        example = f"{{{key.partition('.')[2]}: 10}}"
        return f"{key}: limits are given together, cost_limits='{example}'."
    wrong = ("-", f"{given}=", f"{key}=")
    settings = (word for word in words if "=" in word)
    others = [word for word in settings if not word.lstrip("+~").startswith(wrong)]
    folders = [word for flag, word in pairwise(words) if flag in ("--config-dir", "-cd")]
    folders += [word.partition("=")[2] for word in words if word.startswith("--config-dir=")]
    try:
        config = _compose([*_searched(folders), *others], name)
    except (HydraException, OmegaConfBaseException):
        is_sweep = {"-m", "--multirun"} & {*words}
        of_algorithm = is_sweep and not key.startswith("transforms.")
        hint = f" If only swept algorithms have it, write '++{key}=…'." if of_algorithm else ""
        return unknown_key(key, []) + hint
    section = key.partition(".")[0]
    if OmegaConf.is_missing(config, section):
        return _absent(section)
    if section == "env" and "kwargs" in config.env:
        name = key.removeprefix("env.").removeprefix("kwargs.")
        if guess := nearest(name, map(str, config.env), 0.7):
            return f"there is no key '{key}'. Did you mean 'env.{guess}'?"
        return (
            f"there is no key '{key}'. Arguments of the environment's constructor are given as "
            f"env.kwargs='{{{name}: …}}'."
        )
    own = rf"\+*{section}(\._target_=|=.*\b_target_: ?)(?!['\"]? ?safe_rl\.)"
    if any(re.match(own, word) for word in words) and not key.endswith("._target_"):
        return f"there is no key '{key}'. What a class of yours takes is added: '+{key}=…'."
    return unknown_key(key, keys_of(config))


def _foreign_key(file: str, section: str, key: str) -> str:
    """A message about a key of a chosen file that other choices do not have."""
    is_of_ours = key.startswith("env.") and key.removeprefix("env.") in KEYS
    where = " Environments of Safety Gym have it, such as env=PointGoal1." if is_of_ours else ""
    return f"{'='.join(file.rsplit('/', 1))} sets '{key}', which {section} does not have.{where}"


def read_resumed(
    directory: Path, modules: Sequence[str] | None, words: Sequence[str]
) -> dict[str, Any]:
    """Read a run's configuration as a primary configuration for Hydra.

    `modules` are those of ``import=``, None without it; `words` the others of the command.

    Raises:
        ValueError: If the run cannot be continued, or a word does not go with ``resume=``.
    """
    config = _read(directory)
    check_imports(config, modules, directory)
    for word in words:
        key = word.lstrip("+~").partition("=")[0]
        if word in ("-m", "--multirun") or key in ("hydra.run.dir", "hydra.sweep.dir"):
            raise ValueError(
                f"'{word}': resume= continues one run in its folder. To continue a sweep, start it "
                "again as it was: finished runs are skipped, interrupted ones continue."
            )
    _refuse_foreign_cluster(config, words, directory)
    if modules is not None:
        config["import"] = list(modules)
    for name in ("policy_update", "critic_update"):
        part = config.get(name) or {}
        if part.get("compile", "") == config.get("compile"):  # they follow it, as in a new run
            config[name] = {**part, "compile": "${compile}"}
    if any(re.match(r"logger='?\w", word) for word in words):
        config.pop("logger", None)  # keys of another logger would stay
    place = str(directory).replace("${", "\\${")
    return {
        "defaults": ["_self_", {"logger": None}, {"override hydra/job_logging": "stdout"}],
        "hydra": {"run": {"dir": place}, "output_subdir": None},
        **config,
    }


def _read(directory: Path) -> dict[str, Any]:
    run = Run(directory)
    try:
        config = dict(run.settings)
        if run.checkpoints_folder.exists() and not run.has_begun:
            raise ValueError(
                "it has no progress.csv: an exported policy cannot be trained on; restore a run's"
            )
        for key in ("hydra", "defaults"):
            if key in config:
                raise ValueError(f"{run.config_file.name} has the key '{key}', which no run writes")
        return config
    except (OSError, ValueError) as error:
        raise ValueError(f"resume={directory}: {error}") from None


def _refuse_foreign_cluster(
    config: Mapping[str, Any], words: Sequence[str], directory: Path
) -> None:
    """Refuse settings of Ray that come from a file: they can run code, so the user gives them."""
    given = {word.lstrip("+").partition("=")[0] for word in words}
    for key, value in flatten({"collector": config.get("collector") or {}}).items():
        is_of_ray = re.match(r"collector\.(ray_init|resources)\.(?!num_[cg]pus$)", key)
        if is_of_ray and value is not None and key not in given:
            raise ValueError(
                f"{directory} has {key}. It is not taken from a file, because it could run code: "
                f"give it again, {key}=…"
            )


def refuse_changes(directory: Path, config: DictConfig) -> None:
    """Refuse, by a ValueError, a configuration that differs from the run's in a key that stays."""
    settings = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    given: Any = OmegaConf.to_container(settings, resolve=True)
    if changed := differences(Run(directory).settings, given, "may_change"):
        key, (before, now) = next(iter(changed.items()))
        raise ValueError(
            f"{key}={now} cannot change in a run that is continued (it was {before}). You may "
            "change frames, keys of the machine such as checkpoint.interval, and single numbers "
            "below loss, limits, policy_update and so on, but not an optimiser's lr: the "
            "checkpoint has it. For a new run from this run's networks use "
            f"{quote(f'init_from={quote(str(directory))}')}."
        )
