"""What was meant by a key that nothing reads: one of the run's, or of a file that it lacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from safe_rl.naming import nearest

__all__ = ["choice_with", "keys_meant", "paths_of"]

_LIKENESS = 0.6
_WHOLE = ("cost_limits", "default_cost_limits", "model.input_scale", "paper")
_LARGE = ("env", "algo", "preset")
"""Groups whose files differ in more than a few keys."""
_LISTS = ("transforms",)

_ELSEWHERE = {
    "frames": "total_steps total_timesteps total_frames timesteps max_steps epoch epochs",
    "frames_per_batch": "n_steps rollout_length step_per_epoch",
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
}
"""Key, or its end -> what other libraries call it."""
_ALWAYS = ("env", "algo", "logger", "hydra.run.dir", "+note")


def keys_meant(
    key: str, written: Sequence[str], optional: Sequence[str] = (), refused: Sequence[str] = ()
) -> list[str]:
    """Keys with the last name of a wrong one, or its meaning elsewhere, or else those most like it.

    Args:
        key: The wrong one.
        written: Full paths of all that a configuration holds and its algorithm reads.
        optional: Full paths of what it lacks and its parts would read.
        refused: Full paths of what it holds and its algorithm does not read.

    Examples:
        >>> keys_meant("lr", ["policy_update.optimizer.lr", "frames"])
        ['policy_update.optimizer.lr']
        >>> keys_meant("total_timesteps", ["frames", "env.num_steps"])
        ['frames']
        >>> keys_meant("frmaes", ["frames", "env.num_steps"])
        ['frames']
    """
    name = _end(key)
    exact = (_ending(name, written), _elsewhere(name, written), _ending(name, optional))
    if found := next(filter(None, (*exact, _ending(name, refused))), None):
        return found
    paths = [*written, *optional]
    whole = nearest(key, paths, _LIKENESS)
    end = nearest(name, map(_end, paths), _LIKENESS)
    if whole is not None or end is None:
        return [] if whole is None else [whole]
    return _ending(end, paths)


def _elsewhere(name: str, written: Sequence[str]) -> list[str]:
    word = name.lower().replace("-", "_")
    for key, words in _ELSEWHERE.items():
        if word in words.split():
            found = [key] if key in _ALWAYS or key in written else _ending(key, written)
            if found:
                return found
    return []


def _ending(name: str, paths: Sequence[str]) -> list[str]:
    return [path for path in paths if _end(path) == name]


def _end(path: str) -> str:
    return path.rpartition(".")[2]


def choice_with(
    key: str, options: Sequence[str], values_with: Callable[[str], Mapping[str, Any]]
) -> str | None:
    """The choice that would bring a key, as ``risk=cvar`` brings ``risk.tail``, or None.

    Args:
        key: Full path.
        options: Names of the files in the group of the key's first part.
        values_with: What a configuration holds with one of these choices; empty if it cannot be.

    Examples:
        >>> held = {"risk=chance": {"risk": {"most_over": 0.1}}, "risk=cvar": {"risk": {"tail": 0.1}}}
        >>> choice_with("risk.tail", ["chance", "cvar"], held.get)
        'risk=cvar'
    """  # noqa: E501
    section, _, rest = key.partition(".")
    if section in _LARGE or not rest:
        return None
    for option in options:
        choice = f"{section}=[{option}]" if section in _LISTS else f"{section}={option}"
        if any(f"{path}.".startswith(f"{key}.") for path in paths_of(values_with(choice))):
            return choice
    return None


def paths_of(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Full paths of everything that can be overridden.

    Examples:
        >>> list(paths_of({"seed": 0, "risk": {"tail": 0.1, "_target_": "a.B"}}))
        ['seed', 'risk.tail']
    """
    for key, value in values.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping) and path not in _WHOLE:
            yield from paths_of(value, f"{path}.")
        elif not str(key).startswith("_"):
            yield path
