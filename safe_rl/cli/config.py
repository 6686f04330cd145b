"""The keys of a run that belong to no part: types for Hydra, ranges for pydantic.

Hydra composes every configuration on top of `General`, so it refuses unknown keys and values of
another type. OmegaConf does not know ranges: `check_settings` checks them once, when a run starts.
Defaults are in ``conf/``. Settings of parts, which have a ``_target_``, are described and checked
by the parts' constructors; an environment checks its own.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, Literal, get_args, get_type_hints

from annotated_types import Interval
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from pydantic import GetPydanticSchema, NonNegativeFloat, NonNegativeInt, PositiveFloat

from safe_rl.checks import Device, SettingError, Text, check_value, rule
from safe_rl.evaluation.settings import CertificateOptions
from safe_rl.naming import join_keys, nearest
from safe_rl.runs.identity import flatten, is_to_keep_limits, measure_of


def typed(kind: Any) -> GetPydanticSchema:
    """Metadata of ``Annotated[Any, …]``: a type for pydantic alone.

    OmegaConf does not know all types. It refuses 3e5 as an `int`, and merges a mapping that the
    command line gives into a typed one.
    """
    return GetPydanticSchema(lambda _, handler: handler(kind))


Whole = Annotated[Any, typed(Annotated[int, Interval(ge=1, le=10**15)])]
"""A whole number above 0, which may be written as 3e5."""
Kept = Annotated[int, Interval(ge=1, le=10_000)]
Width = Annotated[int, Interval(ge=1, le=16_384)]
Folder = Annotated[Text, rule(lambda name: "/" not in name, "a name of a folder, without /")]


@dataclass
class Checkpoint:
    """When checkpoints are written, and which are kept: the section ``checkpoint``."""

    interval: NonNegativeFloat  # seconds between checkpoints
    keep_last: Kept  # number of last checkpoints that are kept
    keep_best: Kept  # number of best checkpoints that are kept besides
    best_over: Kept  # epochs in the mean return and costs by which checkpoints are compared


@dataclass
class Evaluation:
    """Evaluations while training: the section ``evaluation``."""

    interval: Whole  # steps between evaluations
    episodes: Annotated[int, Interval(ge=1, le=10**6)]  # episodes of an evaluation


@dataclass
class Dataset:
    """Transitions that are in the replay buffer from the beginning: the section ``dataset``."""

    path: Text | None  # folder of a recording, or an HDF5 file
    # order of observed columns in a file that does not name them; null: as here
    columns: Annotated[Any, typed(Literal["safety_gymnasium"] | None)]
    safe_episodes: bool  # whether only episodes within the limits are taken
    alone: bool  # whether to learn from the dataset only


@dataclass
class Critics:
    """Sizes of the ensembles of Q functions: the section ``critics``."""

    rewards: Annotated[int, Interval(ge=0, le=1000)]  # number of Q functions of the reward
    costs: Annotated[int, Interval(ge=0, le=1000)]  # number of Q functions of the costs
    cost_values: Any = None  # what a Q function of the costs returns; null: the mean


@dataclass
class Exploration:
    """Exploration of off-policy algorithms: the section ``exploration``."""

    random_steps: Annotated[Any, typed(NonNegativeInt)]  # random steps at the beginning
    # standard deviation of a deterministic policy's noise, in half ranges of actions
    noise: NonNegativeFloat


@dataclass
class Encoders:
    """Encoders of the entries of an observation: the section ``model.encoders``."""

    vector: list[Width]  # widths of the layers for a vector
    channels: list[Width]  # channels of the convolutions for an image
    kernels: list[Width]  # kernel sizes of these convolutions [pixels]
    strides: list[Width]  # strides of these convolutions [pixels]


@dataclass
class Recurrence:
    """A recurrent layer: the section ``model.memory``."""

    size: Width  # size of the recurrent state


@dataclass
class Model:
    """The networks: the section ``model``, unless a ``_target_`` names a function of one's own."""

    hidden_sizes: list[Width]  # widths of the hidden layers
    # logarithm of the initial standard deviation of actions
    initial_log_std: Annotated[float, Interval(ge=-20, le=10)]
    input_scale: dict[str, PositiveFloat]  # factors by component of the observation
    critic_observes: list[Literal["observation", "privileged"]]  # entries that critics read
    # distribution of the actions
    head: Literal["auto", "gaussian", "tanh", "categorical", "one_hot"]
    # bound of normalised observations; null: they are not normalised
    normalise: PositiveFloat | None
    encoders: Encoders | None  # encoders of the entries of an observation
    memory: Recurrence | None  # a recurrent layer


@dataclass
class Algo:
    """The algorithm: the section ``algo``, where one of the user's own may have further keys."""

    name: Folder  # its name in folders and reports
    constrained: bool  # whether it keeps the limits; otherwise costs are only recorded


@dataclass(init=False, repr=False, eq=False)
class General:
    """The keys at the top of a configuration; those of type `Any` hold parts, or have no value."""

    frames: Whole  # environment steps to train for
    # environments that are stepped together
    num_envs: Annotated[Any, typed(Annotated[int, Interval(ge=1, le=10**6)])]
    # steps of all environments in one batch
    frames_per_batch: Annotated[Any, typed(Annotated[int, Interval(ge=1, le=10**8)])]
    # whether environments begin at different steps of their first episodes
    staggered_starts: bool | None
    seed: Annotated[int, Interval(ge=0, le=2**62)]  # seed of the run
    # cost allowed per episode, by cost: cost_limits='{cost: 25}'
    cost_limits: Annotated[Any, typed(dict[str, NonNegativeFloat])]
    init_from: Text | None  # run or checkpoint whose trained networks this run starts from
    record: bool  # whether all transitions are written to disk
    note: Any  # a note, kept in the run's config.yaml
    # modules of the user: a keyword of Python, which only a text can name
    __annotations__["import"] = "list[str]"
    device: Device  # where networks are trained: cpu or cuda
    # threads of physics and torch; null: all cores
    num_threads: Annotated[int, Interval(ge=1, le=1024)] | None
    compile: bool  # whether to compile the losses of on-policy algorithms
    checkpoint: Checkpoint  # when checkpoints are written
    certificate: Any  # the test at the end of a run, see CertificateOptions
    env: Any  # the environment
    transforms: Any  # changes of the problem, by name
    collector: Any  # where environments are stepped
    logger: Any  # a logger besides progress.csv
    algo: Any  # the algorithm
    model: Any  # the networks, see Model
    risk: Any  # the measure of episode costs that is limited
    limits: Any  # how the limit is approached
    lagrangian: Any  # the multiplier
    loss: Any  # the loss of the policy
    policy_update: Any  # the update of the policy
    advantage: Any  # estimator of the reward's advantages
    cost_advantage: Any  # estimator of the costs' advantages
    critic_update: Any  # the update of the critics
    memory: Any  # the replay buffer
    actor: Any  # the policy of off-policy algorithms
    critics: Critics | None  # sizes of the ensembles of Q functions
    exploration: Exploration | None  # exploration of off-policy algorithms
    dataset: Dataset | None  # transitions that are in the replay buffer from the beginning
    evaluation: Evaluation | None  # evaluations while training; null: none
    preset: Text  # name of the preset whose keys replace the algorithm's
    paper: Any  # numbers of algo=paper/… for some robots
    default_cost_limits: Any  # cost_limits unless they are given


_STORE = ConfigStore.instance()
_STORE.store(name="general", node=General)
# choices that leave a part out
_STORE.store(group="risk", name="mean", node={"_target_": None})
_STORE.store(group="logger", name="none", node={"_target_": None})
_STORE.store(group="collector", name="local", node={"_target_": None, "num_collectors": 1})
_STORE.store(group="model", name="mlp", node={"encoders": None, "memory": None})

_PARTS = ("critic_update", "memory", "limits", "lagrangian", "advantage", "cost_advantage", "actor")

# parts that the algorithms which have them cannot do without
_NEEDED = ("loss", "policy_update", "critic_update", "advantage", "actor", "memory", "critics")


def give_limits(config: DictConfig) -> None:
    """Give the default limits to a configuration that has none of its own."""
    if config.get("cost_limits") == "default":
        config.cost_limits = config.default_cost_limits or {}


def check_settings(config: DictConfig) -> None:
    """Check a composed configuration, before anything is built; a SettingError names a wrong key.

    Sections that its algorithm does not have are removed, and whole numbers that are written as 3e5
    become integers.
    """
    try:
        for needed in ("frames", "num_envs", "frames_per_batch"):
            if OmegaConf.is_missing(config, needed):
                raise SettingError(f"{needed} is missing: the file of an algorithm sets it.")
        with open_dict(config):
            for name in [key for key in config if OmegaConf.is_missing(config, key)]:
                del config[name]
            give_limits(config)
            if config.algo.get("constrained") is False:  # presets have limits for others
                config.pop("limits", None)
        _check_parts(config)
        _check(General, config, "")
        _check(Algo, config.algo, "algo", is_open=True)
        _check(CertificateOptions, config.certificate, "certificate")
        for name in {"tail", "deterministic"} & {*config.certificate}:
            raise SettingError(
                f"certificate.{name}: leave it out. The tail is the risk's (risk=cvar "
                "risk.tail=…), and a run is certified with sampled actions."
            )
        if not OmegaConf.is_dict(config.model) or "_target_" not in config.model:
            _check(Model, config.model, "model")
        check_value("env.name", Folder, config.env.name)
        _check_together(config)
    except OmegaConfBaseException as error:  # such as an interpolation of a key that is not there
        line = str(error).partition("\n")[0]
        raise SettingError(f"{error.full_key}: {line}") from None


def _check_together(config: DictConfig) -> None:
    """Refuse settings that are right by themselves and not together."""
    if not config.collector.get("_target_") and config.collector.get("num_collectors") != 1:
        raise SettingError(
            "collector.num_collectors: collector=local is one process; for more use "
            "collector=process or collector=ray."
        )
    measure = measure_of(config)
    if measure != "mean" and not is_to_keep_limits(config):
        raise SettingError(
            f"risk={measure.lower()}: algo={config.algo.name} limits no costs, "
            "so it would have no effect. Choose risk=mean, or an algorithm that keeps cost_limits."
        )
    if (cap := config.certificate.get("cap")) is not None:
        from safe_rl.scores.certificate import Claim  # it imports SciPy

        Claim(config.cost_limits, cap=cap)  # refuses a cap that says nothing


def _check_parts(config: DictConfig) -> None:
    """Refuse what a preset or a command has added to an algorithm without such a part."""
    updates = (config.get(name) for name in ("policy_update", "critic_update"))
    compiled = any(OmegaConf.is_dict(update) and "compile" in update for update in updates)
    if config.get("compile") and not compiled:
        warnings.warn(
            f"compile has no effect: algo={config.algo.name} compiles nothing.", stacklevel=2
        )
    # an algorithm of the user's own may do without some of them
    is_of_package = str(config.algo.get("_target_")).startswith("safe_rl.")
    if is_of_package and (misplaced := General.__annotations__.keys() & config.algo.keys()):
        raise SettingError(
            f"algo.{min(misplaced)}: below 'algo' it has no effect. An algorithm's file begins "
            "with the line '# @package _global_'."
        )
    for name in _NEEDED if is_of_package else ():
        part = config.get(name, "absent")
        if part is None or (OmegaConf.is_dict(part) and part.get("_target_", "") is None):
            raise SettingError(f"{name}=null: the {name} of an algorithm cannot be left out.")
    for name in ("loss", "policy_update", *_PARTS):
        part = config.get(name)
        if part is None:
            continue
        if not OmegaConf.is_dict(part):
            hint = " Limits are given as cost_limits='{cost: 25}'." if name == "limits" else ""
            raise SettingError(
                f"{name}={part}: '{name}' is a section; its keys, which '--cfg job' prints, are "
                f"given one by one, {name}.<key>=….{hint}"
            )
        if "_target_" not in part:
            words = "" if config.preset in ("default", "paper") else f"preset={config.preset}: "
            hint = " For a replay buffer use algo=sac_lagrangian." if name == "memory" else ""
            raise SettingError(f"{words}algo={config.algo.name} has no '{name}'.{hint}")


def _check(section: type, values: Any, above: str, *, is_open: bool = False) -> None:
    """Check the keys of a section, a dataclass; an open one may have others."""
    hints = get_type_hints(section, include_extras=True)
    if not OmegaConf.is_dict(values):
        raise SettingError(f"{above} must have the keys {', '.join(hints)}.")
    for name, value in values.items():
        key = join_keys(above, str(name))
        if name not in hints:
            if is_open or key == "hydra":
                continue
            known = [join_keys(above, other) for other in hints] if above else keys_of(values)
            raise SettingError(unknown_key(key, known))
        # a section may be optional: a union of its dataclass and None
        kinds = [k for k in (hints[name], *get_args(hints[name])) if isinstance(k, type)]
        below = next(filter(is_dataclass, kinds), None)
        if below is None:
            is_plain = not OmegaConf.is_config(value)
            plain = value if is_plain else OmegaConf.to_container(value, resolve=True)
            checked = check_value(key, hints[name], plain)
            if isinstance(value, float) and isinstance(checked, int):
                values[name] = checked
        elif value is not None:
            _check(below, value, key)


def keys_of(config: DictConfig) -> list[str]:
    """Full keys of all values of a configuration, but those such as ``_target_``."""
    plain: Any = OmegaConf.to_container(config)
    return [key for key in flatten(plain) if not key.startswith("hydra.") and "._" not in key]


def unknown_key(key: str, known: Iterable[str]) -> str:
    """A message that a key does not exist; it names keys with the same end, or the nearest one.

    Examples:
        >>> unknown_key("lr", ["seed", "policy_update.optimizer.lr"])
        "there is no key 'lr'. Did you mean 'policy_update.optimizer.lr'?"
        >>> unknown_key("env.hazard_num", ["env.hazards_num", "env.vases_num"])
        "there is no key 'env.hazard_num'. Did you mean 'env.hazards_num'?"
    """
    known = [path for path in known if path != key]
    same = [path for path in known if path.rpartition(".")[2] == key.rpartition(".")[2]]
    names = " or ".join(f"'{path}'" for path in same or filter(None, [nearest(key, known, 0.7)]))
    hint = f"Did you mean {names}?" if names else "'--cfg job' prints all that there are."
    return f"there is no key '{key}'. {hint}"
