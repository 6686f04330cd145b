"""What a wrong key or choice was meant to be, in one line."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.errors import MissingConfigException
from omegaconf import OmegaConf

from safe_rl.cli.schema import KEYS, optional_keys
from safe_rl.envs.errors import on_cpu_only
from safe_rl.envs.families import hint_of_gymnasium
from safe_rl.extras import installing
from safe_rl.files import CONF
from safe_rl.naming import did_you_mean, nearest

__all__ = ["GIVEN_WHOLE", "explain", "unknown_key", "unread_by"]

_PLUGINS = {
    "hydra/launcher=joblib": "sweep",
    "hydra/launcher=ray": "sweep-ray",
    **dict.fromkeys(("hydra/launcher=submitit_local", "hydra/launcher=submitit_slurm"), "submitit"),
    "hydra/sweeper=optuna": "sweep-optuna",
}
GIVEN_WHOLE = {
    **{"cost_limits": "limits", "model.input_scale": "factors"},
    **{f"transforms.{t}.budgets": "budgets" for t in ("saute", "simmer", "early_termination")},
}
"""Mappings that are given all at once, and what is in them."""

_ELSEWHERE = {
    "frames": "total_steps total_timesteps total_frames timesteps max_steps epochs max_epochs",
    "frames_per_batch": "n_steps rollout_length step_per_epoch steps_per_epoch",
    "num_passes": "n_epochs update_iters repeat_per_collect",
    "num_envs": "n_envs vector_env_nums training_num",
    "num_threads": "n_threads torch_threads",
    "env": "env_id env_name environment",
    "algo": "agent algorithm",
    "lr": "learning_rate actor_lr vf_lr",
    "minibatch_size": "batch_size",
    "batch_size": "minibatch_size",
    "capacity": "buffer_size replay_size memory_size",
    "max_kl": "target_kl",
    "target_kl": "max_kl",
    "clip_epsilon": "clip eps_clip clip_range",
    "lmbda": "lam gae_lambda",
    "lagrangian.lr": "lambda_lr penalty_lr",
    "lagrangian.init": "penalty_init lagrangian_multiplier_init",
    "model.hidden_sizes": "net_arch policy_kwargs hidden_layers",
    "checkpoint.interval": "save_freq save_interval",
    "hydra.run.dir": "log_dir logdir output_dir directory out save_path",
    "logger": "wandb use_wandb use_tensorboard",
    "+note": "note notes comment",
    "ppo_lagrangian": "cppo ppolag cppopid pdo ppolagrangian",
    "trpo_lagrangian": "trpolag trpopid ctrpolag",
    "sac_lagrangian": "saclag sacpid csac sacl",
    "td3_lagrangian": "td3lag td3pid ctd3",
    "crpo": "oncrpo",
    "ppo": "ppoearlyterminated pposaute pposimmerpid",
}
"""Key, its end, or an algorithm -> what other libraries call it; algorithms without dashes."""
_ALWAYS = ("env", "algo", "logger", "hydra.run.dir", "+note")
_LARGE = ("env", "algo", "preset")
"""Groups whose files differ in more than a few keys."""
_LIKENESS = 0.6
_MOST_LISTED = 40


def explain(error: Exception, texts: Sequence[str]) -> str:
    """Say in one line what is wrong with overrides, or files, that Hydra could not compose.

    Args:
        error: What Hydra says.
        texts: The overrides.
    """
    words = " ".join(str(error.__cause__ or error if not str(error) else error).split())
    file, _, said = words.removeprefix("In '").partition("': ")
    if isinstance(error, MissingConfigException) and error.missing_cfg_file is not None:
        group, _, name = error.missing_cfg_file.rpartition("/")
        if group != "preset" and f"preset={name}" in texts:  # which chose it
            return f"'preset={name}' is not for this algorithm: {file} has no {group} '{name}'."
        pattern = rf"\+?{group}(@[\w.]+)?=.*{re.escape(name)}"
        given = next((f"'{text}'" for text in texts if re.match(pattern, text)), f"{file}.yaml")
        # for a list of choices, such as transforms=[…], Hydra's error has no options
        known = error.options or GlobalHydra.instance().config_loader().get_group_options(group)
        return f"{given}: {_no_choice(group, name, known)}"
    return f"{file}.yaml: {said}" if words.startswith("In '") else words


def _no_choice(group: str, name: str, known: Sequence[str]) -> str:
    """Say that a group has no file of a name, and which was meant or which there are."""
    listed = f" There are {', '.join(known)}." if known else ""
    if len(known) > _MOST_LISTED:
        listed = " 'python train.py --help' names all there are."
    own = _names_here(name.replace("-", "").replace("_", "")) if group == "algo" else ""
    meant = f" Did you mean '{own}'?" if own in known else did_you_mean(name, known)
    family = hint_of_gymnasium(name) if group == "env" else ""
    extra = _PLUGINS.get(f"{group}={name}")
    install = f" It comes with the extra '{extra}': {installing(extra)}" if extra else ""
    return f"there is no {group} '{name}'.{install or family or meant or listed}"


def unknown_key(given: str, key: str, values: Mapping[str, Any]) -> str:
    """Say that nothing reads a key, and what was meant: another key, or a choice that reads it.

    Args:
        given: The whole override.
        key: Its key.
        values: What the configuration holds without it.
    """
    algo, section = values.get("algo") or {}, key.partition(".")[0]
    if section not in values and section in KEYS and section != "note":  # which is added
        return f"'{given}': algo={algo.get('name')} has no '{section}'."
    if choice := _choice_with(key):
        return f"'{given}': nothing reads '{key}' without {choice}."
    if section == "env" and (hint := on_cpu_only(key.removeprefix("env."))):
        return f"'{given}': nothing reads '{key}'.{hint}"
    unread = unread_by(algo)
    held = [p for p in _paths(values) if not any(f"{p}.".startswith(f"{u}.") for u in unread)]
    optional = {p: f"+{p}" for p in optional_keys(values) if p.split(".")[0] not in unread}
    meant = _meant(key, held, list(optional))
    names = " or ".join(f"'{optional.get(path, path)}'" for path in meant)
    return f"'{given}': nothing reads '{key}'.{f' Did you mean {names}?' if names else ''}"


def unread_by(algo: Mapping[str, Any]) -> Mapping[str, str]:
    """Keys that an algorithm does not read, choices that are not for it, and the reasons.

    Args:
        algo: The node ``algo`` of a configuration.
    """
    from safe_rl.algorithms.build_part import find_recipe  # with torch: not for help and --cfg

    return find_recipe(OmegaConf.create({"algo": dict(algo)})).unused_keys


def _meant(key: str, held: Sequence[str], optional: Sequence[str]) -> list[str]:
    """Keys with the last name of a wrong one, or its name here, or else the one most like it.

    Examples:
        >>> _meant("lr", ["policy_update.optimizer.lr", "frames"], [])
        ['policy_update.optimizer.lr']
        >>> _meant("total_timesteps", ["frames", "env.num_steps"], [])
        ['frames']
        >>> _meant("frmaes", ["frames", "env.num_steps"], [])
        ['frames']
    """
    name = _end(key)
    here = _names_here(name)
    for word, paths in ((name, held), (here, [*_ALWAYS, *held]), (name, optional)):
        if word is not None and word in paths:
            return [word]
        if found := [path for path in paths if path.endswith(f".{word}")]:
            return found
    paths = [*held, *optional]
    if (whole := nearest(key, paths, _LIKENESS)) is not None:
        return [whole]
    end = nearest(name, map(_end, paths), _LIKENESS)
    return [path for path in paths if _end(path) == end]


def _names_here(name: str) -> str | None:
    """What is called here what another library calls by a name."""
    word = name.lower().replace("-", "_")
    return next((own for own, words in _ELSEWHERE.items() if word in words.split()), None)


def _choice_with(key: str) -> str | None:
    """The choice that would bring a key, as ``risk=cvar`` brings ``risk.tail``, or None."""
    section, _, rest = key.partition(".")
    for file in sorted((CONF / section).glob("*.yaml")) if rest and section not in _LARGE else ():
        # a file that begins with '@package _global_' has the whole key
        held = _paths(OmegaConf.to_container(OmegaConf.load(file)))  # type: ignore[arg-type]
        if any(f"{path}.".startswith((f"{rest}.", f"{key}.")) for path in held):
            is_list = section == "transforms"
            return f"{section}=[{file.stem}]" if is_list else f"{section}={file.stem}"
    return None


def _paths(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Full paths of everything that can be overridden."""
    for key, value in values.items():
        path = f"{prefix}{key}"
        is_whole = path in (*GIVEN_WHOLE, "default_cost_limits", "paper")
        if isinstance(value, Mapping) and not is_whole:
            yield from _paths(value, f"{path}.")
        elif not str(key).startswith("_"):
            yield path


def _end(path: str) -> str:
    return path.rpartition(".")[2]
