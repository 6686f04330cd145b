"""Put transitions of a dataset into the replay buffer, before or instead of collected ones."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import EnvBase

from safe_rl.algorithms.replay_buffer import Memory
from safe_rl.collectors import (
    check_steps,
    match_columns,
    read_columns,
    read_dataset,
    safe_episodes,
    safety_gymnasium_columns,
)
from safe_rl.files import read_config
from safe_rl.models.replay_networks import bounded_actions

_OF_SAFETY_GYMNASIUM = re.compile(r"(?:Offline|Safety)+(\w+)Gymnasium-v\d")  # names of files
_ROUNDING = 1e-5  # of the width of the bounds: actions were computed in single precision


def fill_replay_buffer(config: DictConfig, buffer: Memory, env: EnvBase) -> tuple[str, bool]:
    """Fill an empty replay buffer with the dataset of a configuration, if it has one.

    The node ``dataset`` has a ``path``, of a recording's folder or of an HDF5 file, and says with
    ``safe_episodes`` whether only whole episodes within the limits are taken. Actions of an HDF5
    file are in the environment's own units, those of a recording in its policy's.

    Returns:
        Two values. The first is a sentence on the data that the run learns from, a warning that it
        will learn nothing, or an empty text. The second is whether transitions that the run
        collects are added to the buffer.

    Raises:
        ValueError: If ``dataset.alone`` is true without a path; if transitions do not fit the
            environment, lack an entry or are not finite; if no episode is within the limits, or
            the replay buffer is too small.
    """
    node = config.get("dataset") or DictConfig({})
    if node.get("path") is None:
        if node.get("alone"):
            raise ValueError(
                f"dataset.path is missing: algo={config.algo.name} with dataset.alone=true learns "
                "from nothing else. Give the folder of a recording (record=true), or an HDF5 file."
            )
        n = config.memory.get("n_steps", 1)  # the last n of a row wait for their n-step returns
        waiting = 0 if n == 1 else n * env.batch_size.numel() * env.steps_per_decision
        needed = config.exploration.random_steps + waiting
        frames = math.ceil(config.frames / config.frames_per_batch) * config.frames_per_batch
        warning = (
            f"Nothing will be learned: the run has {frames:,} steps, and learning begins after "
            f"{needed:,} (exploration.random_steps, memory.n_steps)."
        )
        return warning if frames < needed else "", True
    path = Path(node.path).expanduser()
    file = path / "data" / "main_data.hdf5"  # in the folder of a dataset of Minari
    node.path = str(file if file.is_file() else path)
    steps, interface = read_dataset(node.path), read_columns(node.path)
    try:
        learns_from = _fill(buffer, steps, interface, node, config.cost_limits, env)
    except (ValueError, FloatingPointError) as error:
        raise ValueError(f"dataset.path={node.path}: {error}") from error
    is_raw = not Path(node.path).is_dir()
    warnings = _other_environment(config) + _ignored_transforms(
        config, is_raw=is_raw, evaluating=bool(interface.get("evaluating"))
    )
    return learns_from + warnings, not node.alone


def _other_environment(config: DictConfig) -> str:
    """A warning if the dataset is of another environment; else an empty text."""
    if file := _OF_SAFETY_GYMNASIUM.search(Path(config.dataset.path).name):
        named = config.env.name.removeprefix("Safety").removeprefix("Safe").partition("-")[0]
        other = f" Warning: they are of {file[0]}, and this environment is {config.env.name}."
        return "" if named == file[1] else other
    here: Any = OmegaConf.to_container(config, resolve=True)
    try:
        there = read_config(Path(config.dataset.path).parent / "config.yaml")
        name = there["env"]["name"]
        if name != config.env.name:
            return f" Warning: they are of {name}, and this environment is {config.env.name}."
        changed = [
            f"env.{key}"
            for key, value in there["env"].items()
            if value is not None and here["env"].get(key, value) not in (value, None)
        ]
        before, now = (dict(config.get("transforms") or {}) for config in (there, here))
    except (OSError, ValueError, LookupError, TypeError):  # it is not in a run's folder
        return ""
    changed += [f"transforms.{key}" for key in {**before, **now} if before.get(key) != now.get(key)]
    return f" Warning: they are of a run with other {', '.join(changed)}." if changed else ""


def _ignored_transforms(config: DictConfig, *, is_raw: bool, evaluating: bool) -> str:
    """A warning on transforms without effect on what was read; else an empty text.

    On a file none has, and on an evaluation none of those that change rewards or ends to learn.
    """
    chosen = config.get("transforms") or {}
    ignored = [
        name for name, node in chosen.items() if is_raw or (evaluating and "budgets" in node)
    ]
    if not ignored:
        return ""
    return (
        f" Warning: transforms=[{','.join(ignored)}] change what the run collects, but not this "
        "dataset: its observations, rewards and ends are used as they are."
    )


def _fill(
    buffer: Memory,
    steps: TensorDictBase,
    interface: Mapping[str, Any],
    node: DictConfig,
    limits: Mapping[str, float],
    env: EnvBase,
) -> str:
    """Put the transitions of a dataset into a replay buffer; return a sentence on them."""
    actions, is_recorded = bounded_actions(env), Path(node.path).is_dir()
    _check_entries(steps, buffer, env, actions)
    held = env.steps_per_decision
    known = interface.get("steps_per_decision", held if is_recorded else 1)
    if known != held:
        raise ValueError(
            f"its actions are held for {known} step(s), and here for {held} "
            "(transforms.action_repeat.k): rewards and costs are sums over these steps."
        )
    costs = [("next", key) for key in env.cost_keys if ("next", key) in steps.keys(True)]
    check_steps({key: steps[key] for key in {*buffer.in_keys, *costs}}, costs)
    warning = _order_columns(steps, interface, node, env)
    if not is_recorded:
        _check_costs_and_ends(steps, env)
        warning += _smaller_actions(steps["action"], env)
    number = steps.batch_size.numel()
    if node.safe_episodes:
        if missing := [key for key in limits if ("next", key) not in steps.keys(True)]:
            raise ValueError(f"it has no {', '.join(missing)}, which cost_limits names.")
        steps = safe_episodes(steps, limits)
    taken = steps.batch_size.numel()
    if not 0 < taken <= buffer.capacity:
        what = " in whole episodes that keep cost_limits" if node.safe_episodes else ""
        raise ValueError(
            f"of its {number:,} transitions {taken:,} are taken{what}. There must be some, and "
            f"room for them: memory.capacity={buffer.capacity}."
        )
    steps["action"] = _in_units_of_policy(steps["action"], interface, is_recorded, env, actions)
    buffer.extend(steps)
    buffer.end_rows()
    kept = "those of whole episodes that keep the limits" if node.safe_episodes else "all"
    return f"Learning from {taken:,} of {number:,} transitions in {node.path}: {kept}.{warning}"


def _check_costs_and_ends(steps: TensorDictBase, env: EnvBase) -> None:
    """Refuse steps [1, M] of a file whose costs or ends cannot be what they are here."""
    for key in env.cost_keys:
        highest = float(getattr(env.full_reward_spec[key], "high", torch.tensor(math.inf)).max())
        found = float(steps["next"].get(key, torch.zeros(1)).max())
        if found > highest * (1 + _ROUNDING):
            raise ValueError(
                f"its {key} is up to {found:g} in a step, that of this environment {highest:g}. "
                "Costs are those of single steps, not sums over an episode or over kinds: rescale "
                "or clip them."
            )
    longest, ends = env.max_episode_steps, steps["next", "done"].flatten().clone()
    ends[-1] = True
    ends = ends.nonzero().flatten()
    lengths = ends.diff(prepend=ends.new_tensor([-1]))
    if lengths.max() > longest:
        raise ValueError(
            f"it has {lengths.max():,} steps without an end, and episodes of this environment have "
            f"at most {longest:,}: mark every end in terminals or timeouts."
        )
    full = ends[lengths == longest]
    full = full[steps["next", "done"].flatten()[full]]  # the last row may go on
    if len(full) > 1 and steps["next", "terminated"].flatten()[full].all():
        raise ValueError(
            f"its episodes of {longest} steps terminate, so these are time-outs, after which "
            "values are bootstrapped: mark them in timeouts only."
        )


def _order_columns(
    steps: TensorDictBase, interface: Mapping[str, Any], node: DictConfig, env: EnvBase
) -> str:
    """Put the columns of observations into the environment's order; return a warning, or ""."""
    named, here = interface.get("columns"), env.column_names
    columns = named
    if named is None and node.get("columns") == "safety_gymnasium":
        columns = safety_gymnasium_columns(here)
    if columns is not None:
        sensors = interface.get("sensors"), env.sensor_keys
        order = match_columns(columns, here, *sensors)
        if order != [*range(len(here))]:
            for key in ("observation", ("next", "observation")):
                steps[key] = steps[key][..., order]
    if named is not None:
        return ""
    match = _OF_SAFETY_GYMNASIUM.search(Path(node.path).name)
    if match and columns is None:
        raise ValueError(
            f"it is of {match[0]}, whose columns have another order: dataset.columns="
            "safety_gymnasium."
        )
    spec, seen = env.observation_spec["observation"], steps["observation"].flatten(0, -2)
    if isinstance(spec, Bounded):
        beyond = (seen < spec.low[0].cpu() - 1e-3) | (seen > spec.high[0].cpu() + 1e-3)
        if number := int(beyond.any(0).sum()):
            files = "Files" if columns is None else "Only files"
            raise ValueError(
                f"{number} of the {len(here)} columns of its observations leave the bounds of this "
                f"environment's: their order is another one. {files} of Safety-Gymnasium and DSRL "
                "need dataset.columns=safety_gymnasium; others can name their columns in the "
                f"attribute observation_columns: {here[0]}, …"
            )
    if columns is not None:
        return ""
    return " Warning: it does not name the columns of its observations, which are used as they are."


def _in_units_of_policy(
    action: Tensor, interface: Mapping[str, Any], is_recorded: bool, env: EnvBase, spec: TensorSpec
) -> Tensor:
    """Actions [N, T, A] of a dataset in the units in which policies choose them.

    HDF5 files have the environment's own units. A recording has those of its policy, which may
    have chosen actions outside the bounds: the environment clipped them.

    Raises:
        ValueError: If actions of a file, or of another environment, are outside the bounds.
    """
    chosen = [spec.low.cpu(), spec.high.cpu()]
    raw = [bound.flatten() for bound in env.action_bounds]
    if is_recorded:
        recorded = _recorded_bounds(interface, chosen + raw)
        action = action.clamp(*recorded[:2])
        if all(map(torch.equal, recorded, chosen + raw)):
            return action
        action = _rescaled(action, recorded[:2], recorded[2:])
    _check_bounds(action, *raw)
    return _rescaled(action, raw, chosen).clamp(*chosen)


def _smaller_actions(action: Tensor, env: EnvBase) -> str:
    """A warning if actions of a file look as if they had been scaled to [-1, 1]; or ""."""
    low, high = (bound.flatten() for bound in env.action_bounds)
    if not ((low < -1) & (high > 1)).any() or action.abs().max() > 1:
        return ""
    return (
        f" Warning: its actions are all within -1 and 1, and the bounds of this environment are "
        f"{low.min():g} and {high.max():g}. They are used as they are: rescale them if they were "
        "scaled."
    )


def _recorded_bounds(interface: Mapping[str, Any], otherwise: list[Tensor]) -> list[Tensor]:
    if interface.get("actions") is None:
        return otherwise
    try:
        names = ("low", "high", "own_low", "own_high")
        bounds = [torch.tensor(interface["actions"][name]).float() for name in names]
        if any(bound.shape != otherwise[0].shape for bound in bounds):
            raise ValueError("there must be one per column")
        return bounds
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"the bounds of its actions cannot be read: {error}") from error


def _rescaled(action: Tensor, old: list[Tensor], new: list[Tensor]) -> Tensor:
    """Actions in other units, whose bounds are known in both."""
    if all(map(torch.equal, old, new)):
        return action
    share = (action - old[0]) / (old[1] - old[0])
    return new[0] + share * (new[1] - new[0])


def _check_bounds(action: Tensor, low: Tensor, high: Tensor) -> None:
    """Refuse actions [N, T, A] outside the bounds [A] by more than a rounding error."""
    action, width = action.flatten(0, 1), _ROUNDING * (high - low)
    beyond = (action < low - width) | (action > high + width)
    if not beyond.any():
        return
    column = int(beyond.sum(0).argmax())
    values = action[:, column]
    raise ValueError(
        f"{beyond.any(-1).float().mean():.1%} of its actions are outside the bounds of this "
        f"environment. Those of column {column} are from {values.min():g} to {values.max():g}, and "
        f"the bounds are {low[column]:g} and {high[column]:g}. Actions of a dataset are in the "
        "environment's own units: rescale them, or remove these episodes."
    )


def _check_entries(
    steps: TensorDictBase, buffer: Memory, env: EnvBase, actions: TensorSpec
) -> None:
    """Refuse transitions of another environment, or without an entry that the loss reads."""
    if missing := [_name(key) for key in buffer.in_keys if key not in steps.keys(True)]:
        why = "which is learned from."
        if "privileged" in missing:
            why = "which critics read: record it, or set model.critic_observes=[observation]."
        raise ValueError(f"it has no {', '.join(dict.fromkeys(missing))}, {why}")
    spec = env.observation_spec
    if isinstance(spec["observation"], Composite) or spec["observation"].ndim != 2:
        raise ValueError("a dataset has vectors as observations, and this environment has others.")
    sizes = {"observations": spec["observation"].shape[-1], "actions": actions.shape[-1]}
    if "privileged" in buffer.in_keys:
        sizes["privileged"] = spec["privileged"].shape[-1]
    for name, size in sizes.items():
        number = steps[name.removesuffix("s")].shape[-1]
        if number != size:
            raise ValueError(
                f"its {name} are {number} numbers, those of this environment {size}. It is a "
                "dataset of another one."
            )


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]
