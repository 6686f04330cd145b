"""What a wrong name on the command line was meant to be, and what is wrong with a file."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from safe_rl.cli.schema import KEYS, SettingError, optional_keys, plain
from safe_rl.naming import did_you_mean, nearest

__all__ = [
    *("COMPOSING_ERRORS", "Composing", "algorithm_meant", "explain", "nobody_reads", "paths_of"),
    "unread_by",
]

COMPOSING_ERRORS = (HydraException, OmegaConfBaseException, YAMLError, ValueError)
"""What Hydra raises about overrides and files."""

_LIKENESS = 0.6
_WHOLE = ("cost_limits", "default_cost_limits", "model.input_scale", "paper")
_LARGE = ("env", "algo", "preset")
"""Groups whose files differ in more than a few keys."""
_LISTS = ("transforms",)

_ELSEWHERE = {
    "frames": (
        "total_steps total_timesteps total_frames timesteps max_steps epoch epochs max_epochs"
    ),
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
}
"""Key, or its end -> what other libraries call it."""
_ALGORITHMS_ELSEWHERE = {
    "ppo_lagrangian": "cppo ppolag cppopid pdo ppolagrangian",
    "trpo_lagrangian": "trpolag trpopid ctrpolag",
    "sac_lagrangian": "saclag sacpid csac sacl",
    "td3_lagrangian": "td3lag td3pid ctd3",
    "crpo": "oncrpo",
    "ppo": "ppoearlyterminated pposaute pposimmerpid",
}
"""Name of an algorithm -> what other libraries call it, without dashes."""
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


def algorithm_meant(name: str, known: Sequence[str]) -> str:
    """Say which algorithm a wrong name means: by its name elsewhere, or the most alike.

    Examples:
        >>> algorithm_meant("CPPO", ["ppo", "ppo_lagrangian"])
        " Did you mean 'ppo_lagrangian'?"
    """
    word = name.lower().replace("-", "").replace("_", "")
    found = (own for own, words in _ALGORITHMS_ELSEWHERE.items() if word in words.split())
    own = next(found, None)
    return did_you_mean(name, known) if own is None else f" Did you mean '{own}'?"


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


def unread_by(algo: Mapping[str, Any]) -> Mapping[str, str]:
    """Keys that an algorithm does not read, choices that are not for it, and the reasons.

    Args:
        algo: The node ``algo`` of a configuration.
    """
    from safe_rl.algorithms.build_part import find_recipe  # with torch: not for help and --cfg

    return find_recipe(OmegaConf.create({"algo": dict(algo)})).unused_keys


def nobody_reads(given: str | None, key: str, values: Mapping[str, Any]) -> str:
    """Say that nothing reads a key, and name those that were meant by their full paths.

    Args:
        given: The whole override.
        key: Its key.
        values: What the configuration holds without it.
    """
    algo = values.get("algo") or {}
    unread = unread_by(algo)

    def reason(path: str) -> str | None:
        heads = [head for head in unread if f"{path}.".startswith(f"{head}.")]
        return unread[heads[0]] if heads else None

    optional = {path: f"+{path}" for path in optional_keys(values) if reason(path) is None}
    held = list(paths_of(values))
    refused = [path for path in held if reason(path) is not None]
    meant = keys_meant(key, [path for path in held if path not in refused], [*optional], refused)
    if meant and meant[0] in refused:
        why = reason(meant[0])
        return f"'{given}': algo={algo['name']} does not read '{meant[0]}'. {why}"
    read = [f"'{optional.get(path, path)}'" for path in meant]
    hint = f" Did you mean {' or '.join(read)}?" if read else ""
    return f"'{given}': nothing reads '{key}'.{hint}"


class Composing:
    """What composes configurations, asked again with fewer overrides to find the wrong one.

    Args:
        compose: Overrides -> configuration.
        options: Group -> names of its files.
    """

    def __init__(
        self,
        compose: Callable[[list[str]], DictConfig],
        options: Callable[[str], Sequence[str]],
    ) -> None:
        self.compose, self.options = compose, options

    def works(self, overrides: list[str]) -> bool:
        """Whether overrides can be composed."""
        try:
            self.compose(overrides)
        except COMPOSING_ERRORS:
            return False
        return True

    def chooses(self, override: str) -> bool:
        """Whether an override chooses a file of a group."""
        return bool(self.options(override.partition("=")[0].lstrip("+").partition("@")[0]))

    def choice_with(self, key: str, right: list[str]) -> str | None:
        """The choice that would bring a key, as ``risk=cvar`` brings ``risk.tail``, or None."""
        section, _, rest = key.partition(".")
        if section in _LARGE or not rest:
            return None
        for option in self.options(section):
            choice = f"{section}=[{option}]" if section in _LISTS else f"{section}={option}"
            try:
                paths = paths_of(plain(self.compose([*right, choice])))
            except (*COMPOSING_ERRORS, SettingError):
                continue
            if any(f"{path}.".startswith(f"{key}.") for path in paths):
                return choice
        return None


def explain(error: Exception, overrides: list[str], composing: Composing) -> str:
    """Say in one line what is wrong with overrides, or files, that Hydra could not compose.

    Args:
        error: What Hydra says.
        overrides: The overrides.
        composing: Composes what some of them choose.
    """
    words = " ".join(str(error.__cause__ or error if not str(error) else error).split())
    if (place := re.match(r"In '([^']+)': (.*)", words)) is not None:  # said of files alone
        return _in_file(place[1], place[2], getattr(error, "options", None))
    if (there := _quoted(r"An item is already at '([^']+)'", words)) is not None:
        return f"'{there}' is there already: write it without +."
    key = _quoted(r"Could not override '([^']+)'", words)
    given = next((text for text in overrides if text.lstrip("+").startswith(f"{key}=")), None)
    if key is None or given is None:
        return _of_a_choice(words, overrides, composing)
    # with all that is right, for what refers to it: the name of env=gymnasium is its env.id
    right = [text for text in overrides if text != given]
    try:
        values = plain(composing.compose(right))
    except COMPOSING_ERRORS as another:
        return explain(another, right, composing)
    inner = _quoted(r"full_key: (\S+)", str(error.__cause__))
    if inner is not None and inner.startswith(f"{key}."):
        section, _, name = inner.rpartition(".")
        head = f"{section}."
        inside = [path.removeprefix(head) for path in paths_of(values) if path.startswith(head)]
        meant = nearest(name, inside)
        advice = f"add +{inner}=…" if meant is None else f"did you mean '{meant}'?"
        return f"'{given}': '{section}' has no '{name}', {advice}"
    section = key.partition(".")[0]
    is_known = section in KEYS and section != "note"  # which is nobody's until it is added
    if section not in values and is_known:
        return f"'{given}': algo={values['algo']['name']} has no '{section}'."
    if (choice := composing.choice_with(key, right)) is not None:
        return f"'{given}': nothing reads '{key}' without {choice}."
    return nobody_reads(given, key, values)


def _of_a_choice(words: str, overrides: list[str], composing: Composing) -> str:
    """Words on what is wrong, after the choice without which the others compose, if it is one."""
    choices = [text for text in overrides if composing.chooses(text)]
    if not composing.works(choices):
        for choice in choices:
            if composing.works([other for other in choices if other != choice]):
                return f"'{choice}': {words}"
    return words


def _in_file(file: str, words: str, options: Sequence[str] | None) -> str:
    """What is wrong with a file of configurations, named by its path in their folder."""
    choice = _quoted(r"Could not override '([^']+)'", words)
    if choice is not None:
        likely = _quoted(r"Did you mean to override (.+)\?$", words)
        advice = "to choose it there, write it without 'override'"
        return (
            f"{file}.yaml: 'override /{choice}' in its defaults, but nothing before chooses "
            f"'{choice}': {advice if likely is None else f'did you mean {likely!r}?'}"
        )
    missing = _quoted(r"Could not (?:find|load) '([^']+)'", words)
    if missing is not None:
        hint = did_you_mean(missing.rpartition("/")[2], options or ())
        return (
            f"{file}.yaml: there is no '{missing}', which its defaults name, or an override of "
            f"them in a file that builds on it.{hint}"
        )
    return f"{file}.yaml: {words}"


def _quoted(pattern: str, words: str) -> str | None:
    found = re.search(pattern, words)
    return None if found is None else found[1]
