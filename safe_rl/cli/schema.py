"""The keys of a run: what each may hold and what it means, and the check of a configuration.

Keys of parts are described by the signatures of these, keys of environments by the environments;
defaults are in ``conf/``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Literal, NamedTuple

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from safe_rl.evaluation.settings import CertificateOptions, Device
from safe_rl.naming import nearest
from safe_rl.parameters import Parameter, Part, SettingError, parameters_of, read_part
from safe_rl.ranges import (
    PART,
    Count,
    NotNegative,
    Options,
    Positive,
    Range,
    Text,
    Values,
    is_text,
    values_of,
)

__all__ = [
    "GIVEN_WHOLE",
    "KEYS",
    "SettingError",
    "check_settings",
    "keys_of",
    "nearest_keys",
    "plain",
]

GIVEN_WHOLE = {
    **{"cost_limits": "limits", "model.input_scale": "factors"},
    **{f"transforms.{t}.budgets": "budgets" for t in ("saute", "simmer", "early_termination")},
}
"""Mappings that are given all at once, and what is in them."""

_FOLDER = Values(lambda v: is_text(v) and "/" not in v, "a text that is not empty and has no /")
_FOLDER_OF_ENV = f"{_FOLDER.words}: it names folders, and env.name=… gives another name"


def _int(low: int, high: int | None = None) -> Any:
    return Annotated[int, Range(low, high)]


_ONE = "1, as collector=local is one process; for more use collector=process or collector=ray"
_Width = Annotated[int, Range(1, 16_384)]
_Widths = list[_Width]
_Limits = dict[str, NotNegative]
_Part = Annotated[Any, PART]
_Few = _int(0, 1000)
_Kept = _int(1, 10_000)
_Head = Literal["auto", "gaussian", "tanh", "beta", "categorical", "one_hot"]

_REQUIRED: dict[str, tuple[Any, str]] = {
    "frames": (Count, "steps to train for"),
    "num_envs": (_int(1, 10**6), "environments that are stepped together"),
    "frames_per_batch": (_int(1, 10**8), "steps of all environments in one batch"),
    # evaluations add to a seed, and environments count in 64 bits
    "seed": (_int(0, 2**62), "seed of the run"),
    "init_from": (Text | None, "folder or checkpoint of the run to start from"),
    "cost_limits": (_Limits, "cost allowed per episode, by cost: '{cost: 25}'"),
    "device": (Device, "where networks are trained: cpu or cuda"),
    # torch starts all of them at once, and crashes where the system gives it no more
    "num_threads": (_int(1, 1024) | None, "threads of physics and torch; null: all cores"),
    "compile": (bool, "whether to compile the losses"),
    "preset": (Text, "set of defaults: default, paper, gpu or hard_tasks"),
    "env": (Options, "the environment: env=PointGoal1"),
    "env.name": (Annotated[str, _FOLDER._replace(words=_FOLDER_OF_ENV)], "name of the environment"),
    "algo": (Options, "the algorithm: algo=cpo"),
    "algo.name": (Annotated[str, _FOLDER], "name of the algorithm"),
    "checkpoint": (Options, "when checkpoints are written"),
    "checkpoint.interval": (NotNegative, "seconds between checkpoints"),
    "checkpoint.keep_last": (_Kept, "number of last checkpoints that are kept besides the best"),
    "collector": (Options, "where environments are stepped: collector=local"),
    "collector.num_collectors": (Annotated[int, Values(lambda v: v == 1, _ONE)], "processes"),
    "logger": (Options, "logger in addition to progress.csv: logger=wandb, logger=none"),
    "model": (Options, "the networks"),
    "model.hidden_sizes": (_Widths, "widths of layers, such as [64, 64]"),
    "model.initial_log_std": (
        Annotated[float, Range(-20, 10)],
        "log of the initial standard deviation of the policy",
    ),
    "model.input_scale": (dict[str, Positive], "factors by observation component"),
    "model.encoders.vector": (_Widths, "widths of the layers of a vector's encoder"),
    "model.encoders.channels": (_Widths, "channels of convolutions for an image"),
    "model.encoders.kernels": (_Widths, "kernel sizes of these convolutions [pixels]"),
    "model.encoders.strides": (_Widths, "strides of these convolutions [pixels]"),
    "model.memory.size": (_Width, "size of the recurrent state"),
    "critics.rewards": (_Few, "number of Q functions of the reward"),
    "critics.costs": (_Few, "number of Q functions of the costs"),
    "dataset.path": (Text | None, "folder of a recording, or an HDF5 file"),
    "dataset.safe_episodes": (bool, "whether only episodes within cost_limits are taken"),
    "dataset.alone": (bool, "whether to learn from the dataset only"),
    "exploration.random_steps": (_int(0), "random steps at the start"),
}
"""What every run has, and every section (``model`` and the like) that a run has."""
_OPTIONAL: dict[str, tuple[Any, str]] = {
    "default_cost_limits": (_Limits | None, "cost_limits unless given"),
    "record": (bool, "whether transitions are written to disk"),
    "note": (Any, "a note on the run, kept in its config.yaml"),
    "import": (Any, "modules of your own, imported first"),
    "paper": (Any, "numbers that preset=paper chooses from"),
    "replay": (Any, "off-policy defaults, which preset=default reads"),
    "transforms": (dict[str, _Part], "changes of the problem: transforms=[saute]"),
    "staggered_starts": (
        bool | None,
        "whether environments start at different steps of an episode",
    ),
    "algo.constrained": (bool, "whether it uses cost_limits; false: costs are only recorded"),
    "checkpoint.keep_best": (_Kept, "number of best checkpoints that are kept"),
    "checkpoint.best_over": (
        _Kept,
        "epochs over which return and costs of candidates are averaged",
    ),
    "certificate": (Options, "the test at a run's end; certificate.episodes=0 for none"),
    "model.head": (_Head, "distribution of the actions"),
    "model.normalise": (Positive | None, "bound of normalised observations; null: not normalised"),
    "model.encoders": (Options | None, "encoders of observed entries: model=dict, model=cnn"),
    "model.memory": (Options | None, "recurrence: model=gru"),
    "advantage": (_Part, "estimator of the reward's advantages"),
    "cost_advantage": (_Part | None, "estimator of the costs' advantages"),
    "lagrangian": (_Part | None, "the multiplier"),
    "risk": (Options | None, "the limited measure: risk=mean, cvar or chance"),
    "limits": (Options | None, "how the limit is approached: limits=default or paper"),
    "memory": (_Part, "the replay buffer of off-policy algorithms"),
    "actor": (_Part, "the policy's network of off-policy algorithms"),
    "critics": (Options, "sizes of the ensembles of Q functions"),
    "dataset": (Options, "recorded transitions that the replay buffer begins with"),
    "exploration": (Options, "exploration of off-policy algorithms"),
    "exploration.noise": (NotNegative, "standard deviation of a deterministic actor's noise"),
    "evaluation": (Options | None, "evaluation while training"),
    "evaluation.interval": (Count, "steps between evaluations"),
    "evaluation.episodes": (_int(1, 10**6), "episodes of an evaluation"),
    "loss": (_Part, "the policy's loss"),
    "policy_update": (_Part, "the update of the policy"),
    "then": (dict[str, dict[str, _Part]], "losses and updates after policy_update"),
    "critic_update": (_Part, "the update of the critics"),
}

KEYS = {
    path: Parameter(values_of(kind), meaning, is_required=rows is _REQUIRED)
    for rows in (_REQUIRED, _OPTIONAL)
    for path, (kind, meaning) in rows.items()
} | {
    f"certificate.{name}": row._replace(is_required=False)
    for name, row in parameters_of(CertificateOptions).items()
    if name != "tail"  # that of the risk
}
"""By full path: all keys but those of parts and environments."""
_LIKENESS = 0.6
"""Likeness from which a key is taken for a misspelt one."""


class _Node(NamedTuple):
    """A mapping of a configuration.

    Attributes:
        path: Its key.
        values: What it holds.
        part: What its keys may hold, and which there are.
        is_built: Whether a class is built from it.
    """

    path: str
    values: Mapping[str, Any]
    part: Part
    is_built: bool = False


def check_settings(config: DictConfig) -> None:
    """Check every key but the environment's: by `KEYS`, those of parts by their signatures.

    Custom parts are checked like the package's. Whole numbers that are written as 3e5 become
    integers.

    Args:
        config: Configuration as composed from ``conf/``.

    Raises:
        SettingError: For the first key that does not exist or holds what it cannot.
        TargetError: For a part that cannot be built.
    """
    for path, values, part, is_built in _nodes(plain(config)):
        for name, row in part.rows.items():
            if name in values:
                row.check(_join(path, name), values[name])
                if row.values.whole:
                    holder = OmegaConf.select(config, path) if path else config
                    holder[name] = _whole(values[name])
            elif row.is_required and not is_built:
                raise SettingError(f"{_join(path, name)} is missing: {row.meaning}.")
        known = list(values) if part.names is None else part.names
        for name in values:
            if name not in known and not str(name).startswith("_"):
                meant = nearest_keys(name, known)
                hint = f" Did you mean '{_join(path, meant[0])}'?" if meant else ""
                raise SettingError(f"there is no key '{_join(path, name)}'.{hint}")


def plain(config: DictConfig) -> dict[str, Any]:
    """A configuration as dictionaries and lists, without Hydra's own node.

    Raises:
        SettingError: If a value refers to one that is not there.
    """
    try:
        own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        return OmegaConf.to_container(own, resolve=True)  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        raise SettingError(f"{error.full_key}: {str(error).partition(chr(10))[0]}") from None


def nearest_keys(key: str, known: Iterable[str]) -> list[str]:
    """Keys that a wrong one may stand for: those with its last name, or else those most like it.

    Examples:
        >>> nearest_keys("lr", ["policy_update.optimizer.lr", "frames"])
        ['policy_update.optimizer.lr']
        >>> nearest_keys("frmaes", ["frames", "env.num_steps"])
        ['frames']
    """
    paths, name = list(known), _end(key)
    if same := [path for path in paths if _end(path) == name]:
        return same
    if (whole := nearest(key, paths, _LIKENESS)) is not None:
        return [whole]
    end = nearest(name, map(_end, paths), _LIKENESS)
    return [path for path in paths if _end(path) == end]


def keys_of(values: Mapping[str, Any]) -> Iterator[tuple[str, bool]]:
    """Full paths of what a configuration holds, and of what its parts would read besides.

    Yields:
        A path, and whether the configuration holds it.
    """
    whole = (*GIVEN_WHOLE, "default_cost_limits", "paper")
    for node in _nodes(values):
        held = [name for name in node.values if not str(name).startswith("_")]
        for name in held if not node.path.startswith(whole) else ():
            path = _join(node.path, name)
            if not isinstance(node.values[name], Mapping) or path in whole or node.path == "env":
                yield path, True
        if node.is_built:
            yield from ((_join(node.path, k), False) for k in node.part.settings if k not in held)


def _nodes(values: Mapping[str, Any], path: str = "") -> Iterator[_Node]:
    """Mappings of a configuration, each before those within it."""
    target = values.get("_target_")
    if path == "env":
        yield _Node(path, values, Part({"name": KEYS["env.name"]}, None))
        return
    if target is not None and path != "algo":
        yield _Node(path, values, read_part(target, path), is_built=True)
    else:
        head = f"{path}." if path else ""
        rows = {key.removeprefix(head): row for key, row in KEYS.items() if key.startswith(head)}
        own = {name: row for name, row in rows.items() if "." not in name}
        # a section has no other keys than its rows; others may be tables of an algorithm's own
        is_closed = path == "logger" or bool(path and own)
        yield _Node(path, values, Part(own, list(own) if is_closed else None))
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _nodes(value, _join(path, name))


def _whole(value: Any) -> Any:
    if isinstance(value, list):
        return [_whole(item) for item in value]
    return int(value) if isinstance(value, float) else value


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else str(name)


def _end(path: str) -> str:
    return path.rpartition(".")[2]
