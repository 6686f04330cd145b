"""What the keys of a run's configuration mean, and which define its experiment.

All code that compares runs uses the roles of keys: ``resume=``, sweeps with their folders, reports.
Hydra's notes of a run have the settings of its command line: its command is made again from them.
"""

from __future__ import annotations

import json
import math
import os
import shlex
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from enum import Enum
from typing import Any

import yaml
from omegaconf import DictConfig

from safe_rl.checks import is_number
from safe_rl.files import PROGRAM
from safe_rl.runs.folder import common_source


class Role(Enum):
    """The purpose of a key."""

    EXPERIMENT = "names the experiment: states that are restored with a run depend on it"
    LEARNING = "names the experiment: a number that may change during a run"
    LENGTH = "names the experiment: its runs may be made longer"
    SEED = "distinguishes the runs of an experiment"
    MANNER = "how a run is carried out: names nothing, and stays"
    MACHINE = "belongs to the machine"


OF_EXPERIMENTS = frozenset({Role.EXPERIMENT, Role.LEARNING, Role.LENGTH})
"""Roles of keys: runs that differ in one of these are different experiments."""
RESUMABLE = frozenset({Role.LEARNING, Role.LENGTH, Role.MACHINE})
"""Roles of keys that ``resume=`` may change."""
_SWEPT = frozenset({Role.LENGTH, Role.MACHINE})

ROLES: dict[str, Role] = {
    "seed": Role.SEED,
    "frames": Role.LENGTH,
    "advantage": Role.LEARNING,
    "cost_advantage": Role.LEARNING,
    "critic_update": Role.LEARNING,
    "dataset.path": Role.LEARNING,  # the data may have moved
    "policy_update": Role.LEARNING,
    "lagrangian": Role.LEARNING,
    "limits": Role.LEARNING,
    "limits.frames": Role.LENGTH,
    "loss": Role.LEARNING,
    # restored from checkpoints: another value would have no effect, or not fit
    "critic_update.optimizer": Role.EXPERIMENT,
    "policy_update.optimizer": Role.EXPERIMENT,
    "policy_update.rates": Role.EXPERIMENT,
    "lagrangian.init": Role.EXPERIMENT,
    "lagrangian.scale": Role.EXPERIMENT,
    "lagrangian.derivative_delay": Role.EXPERIMENT,
    "loss.alpha_init": Role.EXPERIMENT,
    "*._target_": Role.EXPERIMENT,
    "algo.constrained": Role.MANNER,  # it follows from the rest of the algorithm
    "collector": Role.MANNER,
    "collector.ray_init": Role.MACHINE,
    "default_cost_limits": Role.MANNER,
    "evaluation": Role.MANNER,
    "memory.keep": Role.MANNER,
    "note": Role.MANNER,
    "certificate": Role.MACHINE,  # about a finished run; training does not depend on it
    "checkpoint": Role.MACHINE,
    "compile": Role.MACHINE,
    "env.physics_buffers": Role.MACHINE,
    "*.compile": Role.MACHINE,
    "policy_update.cuda_graph": Role.MACHINE,
    "device": Role.MACHINE,
    "import": Role.MACHINE,
    "logger": Role.MACHINE,
    "num_threads": Role.MACHINE,
    "record": Role.MACHINE,  # which files of a run are kept
}
"""Key -> its role and that of all keys below it; ``*.name`` is any key that ends in ``.name``.

All other keys are EXPERIMENT.
"""

# keys that configurations of archived runs lack, or those of new ones, as the keys are gone -> the
# values that these runs have; keys with these values are left out of comparisons
_SILENT: dict[str, Hashable] = {
    "env.physics": "cpu",
    "env.physics_buffers": 2.0,
    "env.observe_privileged": False,
    "loss.cost_gamma": None,
    "model.critic_observes": ("observation",),
    "policy_update.fisher_subsample": 1.0,
    "policy_update.rescale_violation": True,
    "risk.ramp_start": 0,
    "risk.ramp_steps": 0,
}


def role_of(key: str) -> Role:
    """The role of a dotted key: that of its own row, or of the nearest key above it with a row.

    Examples:
        >>> role_of("policy_update.max_kl").name, role_of("policy_update.optimizer.lr").name
        ('LEARNING', 'EXPERIMENT')
        >>> role_of("critic_update.compile").name, role_of("env.hazards_num").name
        ('MACHINE', 'EXPERIMENT')
    """
    names = key.split(".")
    above = [".".join(names[:depth]) for depth in range(len(names), 0, -1)]
    role = next((ROLES[row] for row in above if row in ROLES), Role.EXPERIMENT)
    # a row ``*.name`` holds only below keys that define the experiment
    return ROLES.get(f"*.{names[-1]}", role) if role in OF_EXPERIMENTS and names[1:] else role


def experiment_of(config: Mapping[str, Any]) -> dict[str, Hashable]:
    """Dotted key -> value of all keys that define the experiment of a resolved configuration.

    Runs for which these are equal differ only in the seed, and in where and how they were run.
    ``init_from`` is reduced to the part that all seeds share (`common_source`).

    Examples:
        >>> experiment_of({"env": {"name": "PointGoal1"}, "seed": 3, "num_threads": 2})
        {'env.name': 'PointGoal1'}
    """
    return {
        key: common_source(str(value)) if key == "init_from" and value is not None else value
        for key, value in _comparable(config).items()
        if role_of(key) in OF_EXPERIMENTS
    }


def differences(
    saved: Mapping[str, Any], given: Mapping[str, Any], allowed: Collection[Role] = _SWEPT
) -> dict[str, tuple[Any, Any]]:
    """Dotted key -> saved and given value, of keys that differ although their roles forbid it.

    Keys of the roles `allowed` may differ: by default those in which a job of a sweep may continue
    a run that has another value.

    Examples:
        >>> differences({"seed": 0, "frames": 10}, {"seed": 1, "frames": 20})
        {'seed': (0, 1)}
    """
    both = [_comparable(config) for config in (saved, given)]
    return {
        key: (both[0].get(key), both[1].get(key))
        for key in sorted({*both[0], *both[1]})
        if both[0].get(key) != both[1].get(key) and role_of(key) not in allowed
    }


def changed_settings(composed: Any, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted key -> present value, of keys that ``resume=`` has changed since a run was composed.

    Examples:
        >>> changed_settings({"seed": 0, "loss": {"clip_epsilon": 0.2}},
        ...                  {"seed": 0, "loss": {"clip_epsilon": 0.1}, "frames": 20})
        {'loss.clip_epsilon': 0.1}
    """
    before = flatten(composed) if isinstance(composed, Mapping) else {}
    return {
        key: value
        for key, value in flatten(settings).items()
        # values that Hydra computes are not known: nothing of a file is resolved
        if key in before
        and before[key] != value
        and "${" not in str(before[key])
        and role_of(key) in OF_EXPERIMENTS
    }


def _comparable(config: Mapping[str, Any]) -> dict[str, Hashable]:
    flat = flatten(config)
    transforms = config.get("transforms") or {}
    if len(transforms) > 1:
        flat["transforms"] = tuple(transforms)  # their order
    return {key: value for key, value in flat.items() if (key, value) not in _SILENT.items()}


def flatten(settings: Mapping[str, Any]) -> dict[str, Hashable]:
    """Nested settings as one mapping with dotted keys; lists become tuples.

    Examples:
        >>> flatten({"model": {"hidden_sizes": [64, 64], "input_scale": {}}, "seed": 1})
        {'model.hidden_sizes': (64, 64), 'seed': 1}
    """
    flat: dict[str, Hashable] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat |= {f"{key}.{name}": leaf for name, leaf in flatten(value).items()}
        else:
            flat[str(key)] = _hashable(value)
    return flat


def _hashable(value: Any) -> Hashable:
    if isinstance(value, Mapping):
        return tuple((key, _hashable(item)) for key, item in value.items())
    return tuple(map(_hashable, value)) if isinstance(value, list | tuple) else value


def measure_of(settings: Any) -> str:
    """Which measure of episode costs a configuration limits: ``mean``, or the risk's class.

    Examples:
        >>> measure_of({"risk": {"_target_": "safe_rl.objectives.CVaR"}}), measure_of({})
        ('CVaR', 'mean')
    """
    target = (settings.get("risk") or {}).get("_target_") or "mean"
    return str(target).rpartition(".")[2]


def whole_frames(config: DictConfig) -> int:
    """Environment steps after which a run ends: ``frames``, rounded up to whole batches."""
    return math.ceil(config.frames / config.frames_per_batch) * config.frames_per_batch


def is_to_keep_limits(config: DictConfig) -> bool:
    """Whether the algorithm keeps limits, or a transform gives every episode a cost budget."""
    transforms = (config.get("transforms") or {}).values()
    is_constrained = config.algo.get("constrained") is not False
    return is_constrained or any("budgets" in transform for transform in transforms)


def unusable_keys(settings: dict[str, Any]) -> list[str]:
    """Keys of a configuration that are missing, or that no run would have like this.

    Examples:
        >>> good = {"env": {}, "algo": {"name": "cpo"}, "seed": 0, "cost_limits": {"cost": 25}}
        >>> unusable_keys(good), unusable_keys(good | {"import": 5, "algo": 3})
        ([], ['algo', 'import'])
    """
    env, algo = settings.get("env"), settings.get("algo")
    limits, frames = settings.get("cost_limits"), settings.get("frames", 0)
    modules = settings.get("import") or []
    groups = ("transforms", "risk", "checkpoint", "certificate", "collector", "hydra")
    usable = {
        "env": isinstance(env, dict) and _is_name(env.get("name", "")),
        "algo": isinstance(algo, dict) and _is_name(algo.get("name", 0)),
        "seed": type(settings.get("seed")) is int,
        "cost_limits": isinstance(limits, dict) and all(map(is_number, limits.values())),
        "frames": is_number(frames) and frames >= 0,
        "import": isinstance(modules, list) and all(isinstance(name, str) for name in modules),
        "init_from": isinstance(settings.get("init_from"), str | None),
        **{key: isinstance(settings.get(key), dict | None) for key in groups},
    }
    return [key for key, is_usable in usable.items() if not is_usable]


def _is_name(value: Any) -> bool:
    """Whether a value is a name, which as a part of a path cannot lead out of a folder."""
    return isinstance(value, str) and not value.startswith("/") and ".." not in value.split("/")


def config_dirs(notes: Any) -> list[str]:
    """Folders of ``--config-dir``, and of ``config_dir`` in Python, in Hydra's notes of a run.

    They are relative to the folder where the run was started, as the user has typed them.
    """
    try:
        runtime = notes["hydra"]["runtime"]
        sources, start = runtime["config_sources"], runtime.get("cwd")
    except (TypeError, LookupError, AttributeError):
        return []  # there are no notes, or not these
    paths = [s["path"] for s in sources or () if s["provider"].endswith("command-line")]
    return [os.path.relpath(path, start) if start else path for path in paths]


def repeating(
    overrides: Sequence[str], folders: Iterable[str], changed: Mapping[str, Any] = {}
) -> str:
    """The command that repeats a run: from Hydra's notes, and the folders of ``--config-dir``.

    `changed` are `changed_settings`, which the command has from its start.

    Examples:
        >>> words = ["import=['my_gym.py','mine']", "cost_limits={cost: 5}"]
        >>> repeating(words, ["conf"]).partition(" --")[2]
        "config-dir=conf import=my_gym.py import=mine 'cost_limits={cost: 5}'"
    """
    words = [f"--config-dir={folder}" for folder in folders]
    for word in overrides:
        key, _, value = word.partition("=")
        if key == "import":  # Hydra's notes have a list with quotes
            words += [f"import={name}" for name in yaml.safe_load(value)]
        elif key.lstrip("+") not in changed:
            words.append(word)
    words += [f"{key}={json.dumps(value)}" for key, value in changed.items()]
    return shlex.join([*PROGRAM.split(), *words])
