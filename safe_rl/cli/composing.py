"""Compose the configuration of a run by Hydra, and say in one line what is wrong with it.

Commands get their configuration from ``@hydra.main``; Python and tests get the same one here, from
Hydra's `compose`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from shlex import quote
from threading import RLock
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from safe_rl.cli.config import General, keys_of, unknown_key
from safe_rl.cli.folders import name_choices
from safe_rl.cli.options import first_line, unreadable
from safe_rl.envs import store_configs
from safe_rl.envs.families import hint_of_gymnasium
from safe_rl.extras import hint_of_plugin
from safe_rl.files import CONF, PROGRAM
from safe_rl.naming import did_you_mean
from safe_rl.runs.identity import RESUMABLE, differences, flatten
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


_MEANINGS = (
    (
        r"full_key: evaluation(?:\.\w+)?\s+object_type=General",
        "evaluation: give both keys at once, evaluation='{{interval: 10000, episodes: 5}}'.",
    ),
    (
        r"(?s)(?:no attribute|Missing).*full_key: (?!hydra)(\w+)\S*\s+object_type=General",
        "this algorithm has no '{}'.",
    ),
    (
        r"'env\.name' not found|Key 'name' .*\s+full_key: env\.name",
        "env: the file of an environment needs a line 'name: …'.",
    ),
    (r"Missing mandatory value: (\S+)", "{0} has to be given: {0}=…"),
    (
        r"In '(preset)/(\w+)'.*\s+Key '\w+' not in '\w+'\s+full_key: (\S+)",
        "{}={} sets {}, a key that this environment does not have.",
    ),
    (
        r"^'(\w+)/(\S+)' is validated against ConfigStore schema",
        "{}={}: the package has one of this name. Rename your file.",
    ),
)
"""Errors of Hydra and OmegaConf, and what the user has to do."""


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
        if not place.is_dir():  # Hydra would pass over it
            raise ValueError(f"config_dir={place}: there is no such folder.")
    searched = {"hydra.searchpath": [f"file://{place}" for place in places]} if places else {}
    words = [*overrides_of(searched), *words]
    try:
        config = _compose(words, name)
        name_choices(config, config.hydra)
    except COMPOSITION_ERRORS as error:
        raise ValueError(explain(error, [f"--config-name={name}", *words])) from error
    return config


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
    text = str(error)
    if isinstance(error, OverrideParseException):
        return unreadable(str(error.override), error)
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        file = re.match(r"In '(?!config)([^']+)'", text)
        return _unknown_choice(group, name, error.options, file and f"{file[1]}.yaml")
    if text.startswith("Config group override must be"):  # Hydra does not say which
        values = (re.fullmatch(r"(\w+)=(null|true|false|[\d.]+)", word) for word in words)
        if wrong := next((value for value in values if value and _choices(value[1])), None):
            return _unknown_choice(*wrong.groups())
    for pattern, meaning in _MEANINGS:
        if found := re.search(pattern, f"{text}\n{error.__cause__}"):
            return meaning.format(*found.groups())
    if type(error) is AttributeError:
        raise error
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    unknown = re.match(r"Could not override '([^']+)'\.", text)
    if unknown and cause is not error:
        return _unknown_key(cause)
    if unknown and "No match in the defaults list" in text:
        if f"--config-name={RESUMED}" in words:
            return f"{unknown[1]}: a continued run keeps its {unknown[1]}."
        if unknown[1] in General.__annotations__:
            return f"this algorithm has no '{unknown[1]}'."
        return f"{unknown[1]}: nothing is chosen that it could replace; add it, +{unknown[1]}=…"
    return " ".join(text.split()) if cause is error else f"{first_line(error)}: {first_line(cause)}"


def _choices(group: str) -> list[str]:
    """Names of the package's files in a group of Hydra, and of those in its ConfigStore."""
    files = [*(CONF / group).glob("*.yaml"), *ConfigStore.instance().repo.get(group, ())]
    return sorted({Path(file).stem for file in files})


def _unknown_choice(
    group: str, name: str, options: Sequence[str] | None = None, file: str | None = None
) -> str:
    """A message about a file that does not exist, such as ``env=PointGaol1``."""
    known, place = options or _choices(group), f"{file}: " if file else ""
    if file and not known:
        return f"{place}there is no {group}. In 'defaults' write /{Path(group).name}: {name}."
    listed = f"There are {', '.join(known)}"
    if len(known) > _MOST_LISTED:
        listed = f"'{PROGRAM} --help' names all"
    hint = hint_of_gymnasium(name) if group == "env" else hint_of_plugin(f"{group}={name}")
    hint = hint or did_you_mean("none" if name == "null" else name, known, 0.6)
    more = f" {listed}; a file of yours needs --config-dir FOLDER, a module import=FILE.py."
    return f"{place}there is no {group} '{name}'.{hint or more}"


def _unknown_key(error: Any) -> str:
    """A message about a key that the configuration, which OmegaConf's error has, does not have."""
    key, config = str(error.full_key), error.parent_node._get_root()
    section, known = key.partition(".")[0], keys_of(config)
    if section == key:  # the whole section may be wrong, as in los.clip_epsilon=0.1
        known += map(str, config)
    if section == "cost_limits" or key.startswith("limits.cost"):
        cost = key.partition(".")[2]
        given = config.get("cost_limits") not in ("default", {})  # {}: made to hold this key
        added = f" To add this one to those of a file: +cost_limits.{cost}=…" if given else ""
        return f"{key}: limits are given together, cost_limits='{{{cost}: 10}}'.{added}"
    if config.get(section) == {} and section != "transforms":  # made to hold this key
        return f"this algorithm has no '{section}'. If another one of a sweep has it: '++{key}=…'."
    message = unknown_key(key, known)
    if message.endswith("?") or key.rpartition(".")[0] == "transforms":
        return message  # a transform that only some runs of a sweep have cannot be added
    return (
        f"{message} One that a class of yours takes, or another algorithm of a sweep, is added: "
        f"'++{key}=…'."
    )


def read_resumed(
    directory: Path, modules: Sequence[str] | None, words: Sequence[str]
) -> dict[str, Any]:
    """Read a run's configuration as a primary configuration for Hydra.

    `modules` are those of ``import=``, None without it; `words` the others of the command.

    Raises:
        ValueError: If the run cannot be continued, or a word does not go with ``resume=``.
    """
    run = Run(directory)
    try:
        config = dict(run.settings)
    except (OSError, ValueError) as error:
        raise ValueError(f"resume={directory}: {error}") from None
    if run.checkpoints_folder.exists() and not run.has_begun:
        raise ValueError(
            f"resume={directory}: it has no progress.csv: an exported policy cannot be trained on; "
            "restore a run's"
        )
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
        part = config.get(name)
        # they follow it, as in a new run
        if isinstance(part, dict) and part.get("compile", "") == config.get("compile"):
            config[name] = {**part, "compile": "${compile}"}
    if any(re.match(r"logger='?\w", word) for word in words):
        config.pop("logger", None)  # keys of another logger would stay
    place = str(directory).replace("${", "\\${")
    return {
        **config,
        # last: what a file has for Hydra could run code
        "defaults": ["_self_", {"logger": None}, {"override hydra/job_logging": "stdout"}],
        "hydra": {"run": {"dir": place}, "output_subdir": None},
    }


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
    if changed := differences(Run(directory).settings, given, RESUMABLE):
        key, (before, now) = next(iter(changed.items()))
        raise ValueError(
            f"{key}={now} cannot change in a run that is continued (it was {before}). You may "
            "change frames, keys of the machine such as checkpoint.interval, and single numbers "
            "below loss, limits, policy_update and so on, but not an optimiser's lr: the "
            "checkpoint has it. For a new run from this run's networks use "
            f"{quote(f'init_from={quote(str(directory))}')}."
        )
