"""Compose the configuration of a run, and check it before anything is written.

The configuration of a new run is composed from overrides. The configuration of a continued run is
read from its folder as plain values. Hydra reads nothing there, so files that another person has
put into the folder cannot run code.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import IntervalSweep, Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from safe_rl.cli.grammar import CommandLineError, overrides_of, parse
from safe_rl.cli.schema import GIVEN_WHOLE, KEYS, check_settings, plain, unknown_key, unread_by
from safe_rl.cli.user_code import check_imports, note_imports
from safe_rl.envs import complete_env, store_configs
from safe_rl.envs.families import GROUP, env_names, hint_of_gymnasium
from safe_rl.extras import hint_of_plugin
from safe_rl.files import CONF, read_config, read_yaml
from safe_rl.naming import did_you_mean
from safe_rl.runs.identity import flatten, role_of
from safe_rl.runs.run import Run

_ONE_EACH = ("env", "algo", "preset", "model", "risk", "collector", "logger", "lagrangian")
_MOST_LISTED = 40
_MISSING = object()


def compose_jobs(
    texts: Sequence[str], *, sweep: bool = False, shown: bool = False
) -> list[DictConfig]:
    """Compose the configurations that overrides describe, and check them.

    In a sweep, overrides may have several values. Every value is checked once, together with the
    first values of the other overrides. If the configuration is only ``shown``, its values are not
    checked. Returns configurations with the node ``hydra``: one, or all that were checked.

    Raises:
        CommandLineError: If a name does not exist or is not read; the message names similar ones.
        SettingError: If a run cannot have a value.
        ConfigError: If the environment cannot have a value.

    Examples:
        >>> compose_jobs(["env=CarGoal1", "seed=3"])[0].seed
        3
    """
    overrides = [parse(text) for text in texts]
    _check_form(overrides)
    given = [override.key_or_group for override in overrides]
    if sweep and "hydra.run.dir" in given:
        raise CommandLineError("hydra.run.dir is for a single run: write hydra.sweep.dir with -m.")
    if not (sweep or shown) and "hydra.sweep.dir" in given:
        raise CommandLineError("hydra.sweep.dir is for a sweep: add -m, or write hydra.run.dir.")
    with hydra_on_conf():
        jobs = list(_jobs(overrides)) if sweep else [list(texts)]
        configs = [_compose(job) for job in jobs]
    for config in [] if shown else configs:
        _check(config, overrides)
    return configs


@contextmanager
def hydra_on_conf() -> Iterator[Any]:
    """Initialise Hydra on ``conf/``; at the end, restore the state that it had before."""
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
    """Make ``${hydra:…}`` refer to the node ``hydra`` of a configuration."""
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)
    try:
        yield
    finally:
        HydraConfig.instance().cfg = before


def search_folders(folders: Iterable[str | Path]) -> list[str]:
    """The override that adds folders to Hydra's search path; none without folders.

    Raises:
        CommandLineError: If a folder does not exist, or has a file that Hydra would not read.
    """
    paths = [Path(folder).expanduser().absolute() for folder in folders]
    if missing := next((path for path in paths if not path.is_dir()), None):
        raise CommandLineError(f"config_dir={missing}: there is no such folder.")
    if unread := next((file for path in paths for file in _hidden(path)), None):
        raise CommandLineError(f"{unread}: there is a built-in file of this name: choose another.")
    found = [f"file://{path}" for path in paths]
    return list(overrides_of({"hydra.searchpath": found} if found else {}))


def _hidden(folder: Path) -> Iterator[Path]:
    """Files of a folder that are not read, because built-in ones of their names precede them."""
    for file in CONF.rglob("*.yaml"):
        own = folder / file.relative_to(CONF)
        if own.is_file() and own.read_bytes() != file.read_bytes():
            yield own
    named = (folder / GROUP / f"{name}.yaml" for name in env_names())
    yield from (own for own in named if own.is_file())


def _check_form(overrides: Sequence[Override]) -> None:
    """Refuse what Hydra would merge: single keys below `GIVEN_WHOLE`, and lists of choices."""
    for override in overrides:
        key, line = override.key_or_group, override.input_line
        section, _, name = key.rpartition(".")
        if section in GIVEN_WHOLE:
            raise CommandLineError(
                f"'{line}': {GIVEN_WHOLE[section]} are given all at once, as "
                f"{section}='{{{name}: {override.get_value_element_as_str()}}}'."
            )
        values = override.value() if key in _ONE_EACH else ""
        if values is None and not override.is_delete():
            raise CommandLineError(f"'{line}': {key} must be a name. For no logger: logger=none.")
        if isinstance(values, list):
            raise CommandLineError(
                f"'{line}': a run has one {key}; for a run with each of them: "
                f"-m {key}={','.join(map(str, values))}"
            )


def _jobs(overrides: Sequence[Override]) -> Iterator[list[str]]:
    """Overrides of a few jobs in which every value of a sweep occurs."""
    values = [_sweep_lines(override) for override in overrides]
    first = [of_one[0] for of_one in values]
    yield first
    for place, of_one in enumerate(values):
        yield from ([*first[:place], value, *first[place + 1 :]] for value in of_one[1:])


def _sweep_lines(override: Override) -> list[str]:
    """An override for each value of a sweep; for an interval, one for each of its ends."""
    value, key = override.value(), override.get_key_element()
    if isinstance(value, IntervalSweep):
        return [f"{key}={value.start}", f"{key}={value.end}"]
    if override.is_discrete_sweep():
        return [f"{key}={item}" for item in override.sweep_string_iterator()]
    return [str(override.input_line)]


def _compose(texts: list[str]) -> DictConfig:
    try:
        return compose("config", texts, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, YAMLError, ValueError, OSError) as error:
        # where Hydra's message already proposes an override, it stays as it is
        wrong = re.match(r"Could not override '([^']+)'\.(?!\s*Did you mean)", str(error))
        given = next((t for t in texts if wrong and t.lstrip("+").startswith(f"{wrong[1]}=")), None)
        if wrong is None or given is None:
            raise CommandLineError(_explain(error, texts)) from None
        inner = re.search(r"full_key: (\S+)", str(error.__cause__))
        key = inner[1] if inner and inner[1].startswith(f"{wrong[1]}.") else wrong[1]
        # interpolations need the other overrides: env.name of env=gymnasium refers to env.id
        rest = _compose([text for text in texts if text != given])
        meant = [place for place in rest.hydra.runtime.choices if place.endswith(f"@{key}")]
        words = f"write {meant[0]}=…" if meant else unknown_key(key, plain(rest))
        raise CommandLineError(f"'{given}': {words}") from None


def _explain(error: Exception, texts: Sequence[str]) -> str:
    """A message of one line about overrides or files that Hydra could not compose."""
    words = " ".join(str(error.__cause__ or error if not str(error) else error).split())
    if not isinstance(error, MissingConfigException) or error.missing_cfg_file is None:
        return words
    group, _, name = error.missing_cfg_file.rpartition("/")
    # for a list of choices, such as transforms=[…], Hydra's error has no options
    known = error.options or GlobalHydra.instance().config_loader().get_group_options(group)
    all_of_them = f"There are {', '.join(known)}"
    listed = all_of_them if len(known) <= _MOST_LISTED else "'python train.py --help' names all"
    listed = f" {listed}; a file of yours needs --config-dir=FOLDER."
    hint = hint_of_gymnasium(name) if group == "env" else hint_of_plugin(f"{group}={name}")
    file = re.match(r"In '(?!config')([^']+)'", words)
    if file and group != "preset" and f"preset={name}" in texts:  # the preset chose the file
        return f"'preset={name}' is not for this algorithm: {file[1]} has no {group} '{name}'."
    place = f"{file[1]}.yaml: " if file else ""
    return f"{place}there is no {group} '{name}'.{hint or did_you_mean(name, known, 0.6) or listed}"


def _check(config: DictConfig, overrides: Sequence[Override]) -> None:
    try:
        with resolving(config):
            OmegaConf.select(config, "hydra.run.dir")  # it refers to keys that every run has
            _check_read(overrides, config)
            _check_names(overrides, config)
            check_settings(config)
            complete_env(plain(config)["env"])
            _check_top(config)
            check_risk(config)
    except OmegaConfBaseException as error:
        words = " ".join(str(error).split())
        if missing := re.search(r"Missing mandatory value: (\S+)", words):
            words = f"{missing[1]} has to be given: {missing[1]}=…"
        if nameless := re.search(r"key '(env|algo)\.name' not found", words):
            words = f"the file of {nameless[1]}= needs a line 'name: …'"
        raise CommandLineError(words) from None


def _check_read(overrides: Sequence[Override], config: DictConfig) -> None:
    """Refuse overrides of keys that the algorithm does not read."""
    for unread, reason in unread_by(plain(config)).items():
        path, _, choice = unread.partition("=")
        is_chosen = not choice or OmegaConf.select(config, path) == choice
        for override in overrides if is_chosen else ():
            if f"{override.key_or_group.replace('/', '.')}.".startswith(f"{path}."):
                verb = f"algo={config.algo.get('name')} {'has no' if choice else 'does not read'}"
                raise CommandLineError(f"'{override.input_line}': {verb} '{unread}'. {reason}")


def _check_names(overrides: Sequence[Override], config: DictConfig) -> None:
    """Refuse ``env.name`` and ``algo.name`` of another choice: they only name what is chosen."""
    known = {"env": env_names(), "algo": [file.stem for file in (CONF / "algo").glob("*.yaml")]}
    for override in overrides:
        group, _, key = override.key_or_group.partition(".")
        if key == "name" and group in known:
            chosen, name = config.hydra.runtime.choices[group], config[group].name
            if name in known[group] and name != chosen:
                raise CommandLineError(
                    f"'{override.input_line}' would train {group}={chosen} under the name of "
                    f"another one. To choose that one, write {group}={name}."
                )


def _check_top(config: DictConfig) -> None:
    """Refuse unknown top-level keys, such as ``+lr=1e-4``, unless an interpolation uses them."""
    text = OmegaConf.to_yaml(config)
    for head in map(str, config):
        # ${head}, ${head.key}, ${resolver:head.key}
        if head not in (*KEYS, "hydra") and not re.search(rf"[{{:,]{re.escape(head)}[.,}}]", text):
            values = plain(config)
            key = next(iter(flatten({head: values.pop(head)})), head)
            raise CommandLineError(unknown_key(key, values))


def check_risk(config: DictConfig) -> None:
    """Refuse a risk measure that neither the algorithm nor a transform would use."""
    measure = (config.get("risk") or {}).get("_target_")
    is_constrained = config.algo.get("constrained") is not False
    if measure is not None and not is_to_keep_limits(config, is_constrained):
        raise CommandLineError(
            f"risk={measure.rpartition('.')[2].lower()}: algo={config.algo.name} limits no costs, "
            "so it would have no effect. Choose risk=mean, or an algorithm that keeps cost_limits."
        )


def is_to_keep_limits(config: DictConfig, is_constrained: bool) -> bool:
    """Whether the algorithm keeps limits, or a transform gives every episode a cost budget."""
    transforms = (config.get("transforms") or {}).values()
    return is_constrained or any("budgets" in transform for transform in transforms)


def compose_resumed(
    directory: Path, texts: Iterable[str], modules: Sequence[str] | None = None
) -> DictConfig:
    """Return the configuration of the run in a folder, with the changes that overrides make.

    Raises:
        CommandLineError: If it is not the folder of a run, or a key cannot change.
        SettingError: If a run cannot have a value.
    """
    run = Run(directory)
    try:
        run.check_is_run()
        if run.checkpoints_folder.exists() and not run.has_begun:
            raise ValueError("it has no progress.csv: an exported policy cannot be trained on")
        config = OmegaConf.create(read_config(run.config_file))
        said = read_yaml(run.overrides_file) if run.overrides_file.is_file() else None
    except (OSError, ValueError) as error:
        raise CommandLineError(f"resume={directory}: {error}") from None
    check_imports(config, modules, directory)
    overrides = [parse(text) for text in (*texts, *note_imports(modules))]
    _check_form(overrides)
    _refuse_foreign_cluster(config, overrides, run.config_file)
    for override in overrides:
        _change(config, override, directory, said or ())
    _check_read(overrides, config)
    check_settings(config)
    return config


def _change(config: DictConfig, override: Override, directory: Path, said: Sequence[str]) -> None:
    """Change a key of a continued run; overrides that it began with may be repeated."""
    key, line, value = override.key_or_group, override.input_line, override.value()
    before = OmegaConf.select(config, key, default=_MISSING) if "/" not in key else None
    if override.is_sweep_override():
        raise CommandLineError(f"'{line}': a run has one value of this key.")
    if before is _MISSING and not (override.is_add() or override.is_hydra_override()):
        raise CommandLineError(f"'{line}': {unknown_key(key, plain(config))}")
    is_plain = not (override.is_delete() or "/" in key or isinstance(before, DictConfig))
    may_change = is_plain and not override.package and role_of(key).may_change
    is_place = key == "hydra.run.dir" and Path(str(value)).resolve() == directory.resolve()
    if is_place or (is_plain and value == before) or (line in said and not may_change):
        return
    if not may_change:
        raise CommandLineError(
            f"'{line}' cannot change in a run that is continued. You may change frames, keys of "
            "the machine such as checkpoint.interval, and single numbers below loss, limits, "
            "policy_update and so on, but not an optimiser's lr: the checkpoint has it. For a new "
            f"run from this run's networks use init_from={directory}."
        )
    if not override.is_hydra_override():
        OmegaConf.update(config, key, value, force_add=True)


def _refuse_foreign_cluster(config: DictConfig, overrides: Sequence[Override], path: Path) -> None:
    """Refuse settings of Ray that come from a file: they can run code, so the user gives them."""
    said = [override.key_or_group for override in overrides]
    for key, value in flatten({"collector": config.get("collector") or {}}).items():
        is_of_ray = re.match(r"collector\.(ray_init|resources)\.(?!num_[cg]pus$)", key)
        if is_of_ray and value is not None and key not in said:
            raise CommandLineError(
                f"{path} has {key}. It is not taken from a file, because it could run code: "
                f"give it again, {key}=…"
            )
