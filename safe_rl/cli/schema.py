"""The keys of a run: the values and the meaning of each, and the check of a configuration.

Keys of parts are described by the parts' signatures, keys of environments by the environments.
Defaults are in ``conf/``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from safe_rl.envs.errors import on_cpu_only
from safe_rl.evaluation.settings import CertificateOptions, Device
from safe_rl.files import CONF
from safe_rl.naming import join_keys, nearest
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
from safe_rl.runs.identity import flatten

GIVEN_WHOLE = {
    **{"cost_limits": "limits", "model.input_scale": "factors"},
    **{f"transforms.{t}.budgets": "budgets" for t in ("saute", "simmer", "early_termination")},
}
"""Mappings that are given all at once, and what their values are called."""

_FOLDER = Values(lambda v: is_text(v) and "/" not in v, "a text that is not empty and has no /")
_FOLDER_OF_ENV = f"{_FOLDER.words}: it names folders, and env.name=… gives another name"


def _int(low: int, high: int | None = None) -> Any:
    return Annotated[int, Range(low, high)]


_ONE = "1, as collector=local is one process; for more use collector=process or collector=ray"
_Width = Annotated[int, Range(1, 16_384)]
_Widths = list[_Width]
_LogStd = Annotated[float, Range(-20, 10)]
_Limits = dict[str, NotNegative]
_Part = Annotated[Any, PART]
_Few = _int(0, 1000)
_Kept = _int(1, 10_000)
_Head = Literal["auto", "gaussian", "tanh", "beta", "categorical", "one_hot"]

_ROWS: dict[str, tuple[Any, str]] = {
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
    "algo.constrained": (bool, "whether it uses cost_limits; false: costs are only recorded"),
    "checkpoint": (Options, "when checkpoints are written"),
    "checkpoint.interval": (NotNegative, "seconds between checkpoints"),
    "checkpoint.keep_last": (_Kept, "number of last checkpoints that are kept besides the best"),
    "checkpoint.keep_best": (_Kept, "number of best checkpoints that are kept"),
    "checkpoint.best_over": (_Kept, "number of epochs in the mean return and costs of a candidate"),
    "collector": (Options, "where environments are stepped: collector=local"),
    "collector.num_collectors": (Annotated[int, Values(lambda v: v == 1, _ONE)], "processes"),
    "logger": (Options, "logger in addition to progress.csv: logger=wandb, logger=none"),
    "model": (Options, "the networks"),
    "model.hidden_sizes": (_Widths, "widths of layers, such as [64, 64]"),
    "model.initial_log_std": (_LogStd, "log of the policy's initial standard deviation"),
    "model.input_scale": (dict[str, Positive], "factors by observation component"),
    "model.encoders.vector": (_Widths, "widths of the layers of a vector's encoder"),
    "model.encoders.channels": (_Widths, "channels of convolutions for an image"),
    "model.encoders.kernels": (_Widths, "kernel sizes of these convolutions [pixels]"),
    "model.encoders.strides": (_Widths, "strides of these convolutions [pixels]"),
    "model.memory.size": (_Width, "size of the recurrent state"),
    "model.head": (_Head, "distribution of the actions"),
    "model.normalise": (Positive | None, "bound of normalised observations; null: not normalised"),
    "model.encoders": (Options | None, "encoders of observed entries: model=dict, model=cnn"),
    "model.memory": (Options | None, "recurrence: model=gru"),
    "critics": (Options, "sizes of the ensembles of Q functions"),
    "critics.rewards": (_Few, "number of Q functions of the reward"),
    "critics.costs": (_Few, "number of Q functions of the costs"),
    "dataset": (Options, "recorded transitions that the replay buffer begins with"),
    "dataset.path": (Text | None, "folder of a recording, or an HDF5 file"),
    "dataset.columns": (
        Literal["safety_gymnasium"] | None,
        "order of observed columns in a file that does not name them; null: the environment's",
    ),
    "dataset.safe_episodes": (bool, "whether only episodes within cost_limits are taken"),
    "dataset.alone": (bool, "whether to learn from the dataset only"),
    "exploration": (Options, "exploration of off-policy algorithms"),
    "exploration.random_steps": (_int(0), "random steps at the start"),
    "exploration.noise": (NotNegative, "standard deviation of a deterministic actor's noise"),
    "default_cost_limits": (_Limits | None, "cost_limits unless given"),
    "record": (bool, "whether transitions are written to disk"),
    "note": (Any, "a note on the run, kept in its config.yaml"),
    "import": (Any, "modules of your own, imported first"),
    "paper": (Any, "numbers that preset=paper chooses from"),
    "replay": (Any, "off-policy defaults, which preset=default reads"),
    "transforms": (dict[str, _Part], "changes of the problem: transforms=[saute]"),
    "staggered_starts": (bool | None, "whether environments begin at different steps of episodes"),
    "certificate": (Options, "the test at a run's end; certificate.episodes=0 for none"),
    "advantage": (_Part, "estimator of the reward's advantages"),
    "cost_advantage": (_Part | None, "estimator of the costs' advantages"),
    "lagrangian": (_Part | None, "the multiplier"),
    "risk": (Options | None, "the limited measure: risk=mean, cvar or chance"),
    "limits": (Options | None, "how the limit is approached: limits=default or paper"),
    "memory": (_Part, "the replay buffer of off-policy algorithms"),
    "actor": (_Part, "the policy's network of off-policy algorithms"),
    "evaluation": (Options | None, "evaluation while training"),
    "evaluation.interval": (Count, "steps between evaluations"),
    "evaluation.episodes": (_int(1, 10**6), "episodes of an evaluation"),
    "loss": (_Part, "the policy's loss"),
    "policy_update": (_Part, "the update of the policy"),
    "critic_update": (_Part, "the update of the critics"),
}
KEYS = {path: Parameter(values_of(kind), meaning) for path, (kind, meaning) in _ROWS.items()} | {
    f"certificate.{name}": row
    for name, row in parameters_of(CertificateOptions).items()
    if name != "tail"  # that of the risk
}
"""Full key -> its description; all keys but those of parts and environments."""
_ELSEWHERE = {
    **dict.fromkeys(("total_timesteps", "total_steps", "timesteps", "max_steps"), "frames"),
    **dict.fromkeys(("environment", "environment_name", "env_name", "env_id", "task"), "env"),
    **dict.fromkeys(("algorithm", "algo_name"), "algo"),
    **dict.fromkeys(("dir", "directory", "log_dir", "output_dir", "run_dir"), "hydra.run.dir"),
}
"""Name of a key in other libraries -> the key."""
_SYNONYMS = {
    **dict.fromkeys(("clip", "clip_ratio", "clip_range", "clip_coef"), "clip_epsilon"),
    **dict.fromkeys(("discount", "discount_factor"), "gamma"),
    **dict.fromkeys(("epochs", "n_epochs", "num_epochs", "update_iters"), "num_passes"),
    **dict.fromkeys(("lam", "gae_lambda"), "lmbda"),
    **dict.fromkeys(("learning_rate", "actor_lr", "pi_lr"), "lr"),
    "target_kl": "max_kl",
}
"""Last part of a key in other libraries -> the last part of the key."""
_LIKENESS = 0.6
"""Similarity from which on a key counts as a misspelling of another one."""


def check_settings(config: DictConfig) -> None:
    """Check every key but the environment's: by `KEYS`, or by the signature of its part.

    Custom parts are checked like the package's. Whole numbers written as 3e5 become integers in the
    configuration.

    Raises:
        SettingError: For the first key that does not exist or cannot have its value.
        TargetError: For a part that may not be named or does not exist.
    """
    values = plain(config)
    rows = []
    for path, node, part in _nodes(values):
        for name, value in node.items():
            key = join_keys(path, name)
            if name in part.rows:
                rows.append((_origin(config, key), key, path, value, part.rows[name]))
            elif part.names is not None and name not in part.names and str(name)[0] != "_":
                raise SettingError(unknown_key(key, values))
    # copied values last: the range of the key that was given comes before those of its copies
    for origin, key, path, value, row in sorted(rows, key=lambda each: each[0] != each[1]):
        row.check(origin, value)
        if row.values.whole:
            section = OmegaConf.select(config, path) if path else config
            section[key.removeprefix(f"{path}.")] = _whole(value)
    cap = (values.get("certificate") or {}).get("cap")
    if cap is not None and any(cap <= limit for limit in values["cost_limits"].values()):
        raise SettingError(f"certificate.cap={cap}: it must be above every limit of cost_limits.")


def _origin(config: DictConfig, key: str) -> str:
    """The key that a value is copied from, as in ``max_kl: ${loss.max_state_kl}``, or `key`."""
    section, _, name = key.rpartition(".")
    raw: Any = (OmegaConf.select(config, section) if section else config)._get_node(name)
    copied = re.fullmatch(r"\$\{(\w[\w.]*)\}", str(raw._value()))
    return _origin(config, copied[1]) if copied else key


def plain(config: DictConfig) -> dict[str, Any]:
    """A configuration as dictionaries and lists, without the node ``hydra``.

    Raises:
        SettingError: If an interpolation refers to a key that does not exist.
    """
    try:
        own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
        return OmegaConf.to_container(own, resolve=True)  # type: ignore[return-value]
    except OmegaConfBaseException as error:
        raise SettingError(f"{error.full_key}: {str(error).partition(chr(10))[0]}") from None


def unknown_key(key: str, values: Mapping[str, Any]) -> str:
    """A message that a key does not exist, with similar keys, or the choice that has the key."""
    algo, section = values.get("algo") or {}, key.partition(".")[0]
    if section not in values and section in KEYS and section != "note":  # +note= adds a note
        return f"algo={algo.get('name')} has no '{section}'."
    if section == "env" and (reason := on_cpu_only(key.removeprefix("env."))):
        return f"there is no key '{key}'.{reason}"
    if section != "preset" and (choice := _choice_with(key)):  # a preset's keys are at the top
        target = str((values.get(section) or {}).get("_target_") or "safe_rl.")
        own = f": {target} has no such argument, or the YAML file of {section}=… does not name it."
        reason = f" without {choice}." if target.startswith("safe_rl.") else own
        return f"there is no key '{key}'{reason}"
    known, unread = dict(_keys_of(values)), tuple(f"{path}." for path in unread_by(values))
    read = [path for path in known if path != key and not f"{path}.".startswith(unread)]
    held = [path for path in read if known[path]]
    elsewhere = [_ELSEWHERE[key]] if key in _ELSEWHERE else []
    above, _, name = key.rpartition(".")
    is_own = any(path.endswith(f".{name}") for path in read)  # some steps have a target_kl
    ours = key if is_own else join_keys(above, _SYNONYMS.get(name, name))
    meant = elsewhere or _nearest_keys(ours, held) or _nearest_keys(ours, read)
    names = " or ".join(f"'{'' if known.get(path, True) else '+'}{path}'" for path in meant)
    how = f"A new key is added by +{key}=…" if "." in key else "'--cfg job' prints all keys."
    return f"there is no key '{key}'. {f'Did you mean {names}?' if names else how}"


def unread_by(values: Mapping[str, Any]) -> Mapping[str, str]:
    """Keys and choices (``key=choice``) that a run's algorithm does not read -> the reasons."""
    algo = values.get("algo") or {}
    if not str(algo.get("_target_", "safe_rl.")).startswith("safe_rl."):
        return {}
    has_multiplier = any(
        "multiplier" in (part.names or ()) or not str(node["_target_"]).startswith("safe_rl.")
        for path, node, part in _nodes(values)
        if path.split(".")[-1] in ("loss", "policy_update") and "_target_" in node
    )
    idle = {} if has_multiplier else {"lagrangian": "Its loss has no multiplier."}
    if algo.get("constrained") is False:
        idle |= dict.fromkeys(("limits", "cost_advantage"), "It keeps no limits.")
    return idle


def _nearest_keys(key: str, known: list[str]) -> list[str]:
    """Keys with the same last name; else the most similar key, or those with that last name."""
    ends = [path.rpartition(".")[2] for path in known]
    name = key.rpartition(".")[2]
    if name not in ends and (whole := nearest(key, known, _LIKENESS)):
        return [whole]
    end = nearest(name, ends, _LIKENESS)
    return [path for path, other in zip(known, ends, strict=True) if other == end]


def _choice_with(key: str) -> str | None:
    """The choice with a key, as ``risk=cvar`` is for ``risk.tail``; or None."""
    section, _, rest = key.partition(".")
    for file in sorted((CONF / section).glob("*.yaml")) if rest else ():
        held = flatten(OmegaConf.to_container(OmegaConf.load(file)))  # type: ignore[arg-type]
        if any(f"{path}.".startswith((f"{rest}.", f"{key}.")) for path in held):
            name = f"[{file.stem}]" if section == "transforms" else file.stem
            return f"{section}={name}"
    return None


def _keys_of(values: Mapping[str, Any]) -> Iterator[tuple[str, bool]]:
    """Full keys that parts of a configuration would read, and whether it holds them."""
    for path, node, part in _nodes(values):
        if not path.startswith((*GIVEN_WHOLE, "default_cost_limits", "paper")):
            settings = part.settings if "_target_" in node else {}
            names = (*(name for name in node if str(name)[0] != "_"), *settings)
            yield from ((join_keys(path, name), name in node) for name in names)


def _nodes(
    values: Mapping[str, Any], path: str = ""
) -> Iterator[tuple[str, Mapping[str, Any], Part]]:
    """Full key, mapping and allowed keys of each mapping, before those within it."""
    target = values.get("_target_")
    if path == "env":
        yield path, values, Part({"name": KEYS["env.name"]}, None)
        return
    if target is not None and path != "algo":
        yield path, values, read_part(target, path)
    else:
        places = {key: key.rpartition(".") for key in KEYS}
        own = {name: KEYS[key] for key, (section, _, name) in places.items() if section == path}
        # a section has the keys of its rows only; other mappings may be an algorithm's own tables
        is_closed = path == "logger" or bool(path and own)
        yield path, values, Part(own, list(own) if is_closed else None)
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _nodes(value, join_keys(path, name))


def _whole(value: Any) -> Any:
    if isinstance(value, list):
        return [_whole(item) for item in value]
    return int(value) if isinstance(value, float) else value
