"""Parts of off-policy algorithms, as a configuration describes them.

These are the networks, and the transitions of a dataset in the replay buffer, before or instead of
collected ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase

from safe_rl.algorithms.build_part import build_part
from safe_rl.algorithms.constraints import check_cost_limits
from safe_rl.algorithms.replay_buffer import Memory
from safe_rl.collectors import read_dataset, safe_episodes
from safe_rl.files import read_config
from safe_rl.models import ExploringPolicy, QEnsemble, input_scale_vector
from safe_rl.models.encoders import TO_FLATTEN, observed_entries

_ON_POLICY_ONLY = ("encoders", "memory", "normalise")


def setting(config: DictConfig, key: str) -> Any:
    """The value of a required key.

    Raises:
        ValueError: If the key is missing or null.
    """
    value = OmegaConf.select(config, key)
    if value is None:
        raise ValueError(f"{key} is missing: off-policy algorithms need it.")
    return value


def bounded_actions(env: EnvBase) -> TensorSpec:
    """Spec of one environment's bounded action, [A], in single precision like the networks.

    Raises:
        ValueError: If actions are not continuous within finite bounds, or no vectors [A].
    """
    spec = env.action_spec_unbatched
    is_continuous = isinstance(spec, Bounded) and spec.dtype.is_floating_point
    if not is_continuous or not (spec.low.isfinite() & spec.high.isfinite()).all():
        raise ValueError(
            "Off-policy algorithms need continuous actions within bounds, and this environment's "
            f"action_spec is {type(spec).__name__}. Use an on-policy one such as ppo_lagrangian."
        )
    if len(spec.shape) != 1:
        raise ValueError(
            f"An action of this environment has the shape {list(spec.shape)}: policies act by "
            "vectors [A]. Let the environment take them, and give them their shape itself."
        )
    return spec.to(torch.float32)


def exploring(actor: TensorDictModuleBase, env: EnvBase, noise: float) -> ExploringPolicy:
    """The exploring policy of an actor, within the bounds of an environment's actions."""
    spec = bounded_actions(env)
    return ExploringPolicy(actor, spec.low, spec.high, noise=noise)


def build_networks(
    config: DictConfig, env: EnvBase, num_costs: int, device: torch.device
) -> dict[str, Any]:
    """Build the actor and, unless their number in ``critics`` is 0, critics of reward and costs.

    Args:
        config: Configuration as composed from ``conf/``.
        env: Environment whose specs have the sizes of observations and actions.
        num_costs: Number of constrained costs; 0: no cost critics.
        device: Device of the parameters.

    Raises:
        ValueError: If actions have no bounds, the observation is no vector, or the model is one for
            on-policy algorithms.
    """
    model, spec = config.model, bounded_actions(env)
    size, actions = _observation_size(config, env), len(spec.low)
    common: dict[str, Any] = {
        "hidden_sizes": list(model.hidden_sizes),
        "input_scale": input_scale_vector(model.input_scale, env.observation_layout),
        "device": device,
    }
    bounds = {"low": spec.low, "high": spec.high}
    networks = {"actor": build_part(config.actor, observation_size=size, **bounds, **common)}
    if number := setting(config, "critics.rewards"):
        networks["critic"] = QEnsemble(size, actions, num_networks=number, **common)
    if num_costs and (number := setting(config, "critics.costs")):
        common |= {"num_outputs": num_costs, "out_key": "cost_state_action_value"}
        networks["cost_critic"] = QEnsemble(size, actions, num_networks=number, **common)
    return networks


def _observation_size(config: DictConfig, env: EnvBase) -> int:
    """Length of the observation; refuses models and observations that are not of one vector."""
    model = config.model
    if others := [key for key in _ON_POLICY_ONLY if model.get(key)]:
        raise ValueError(
            f"algo={config.algo.name} takes model=mlp only, and model.{others[0]} is for on-policy "
            "algorithms. Use model=mlp without it."
        )
    observed = observed_entries(env.observation_spec)
    if observed[0].key != "observation" or len(observed[0].shape) != 1:
        raise ValueError(
            f"algo={config.algo.name} needs an observation of one vector, and this environment "
            f"observes {', '.join(map(str, observed))}: {TO_FLATTEN}, or use algo=ppo_lagrangian "
            "with model=dict or model=cnn."
        )
    return int(observed[0].shape[0])


def fill_replay_buffer(config: DictConfig, buffer: Memory, env: EnvBase) -> tuple[str, bool]:
    """Fill an empty replay buffer with the dataset of a configuration, if it has one.

    The node ``dataset`` has a ``path``, of a recording's folder or of an HDF5 file, and says with
    ``safe_episodes`` whether only whole episodes within the limits are taken. Actions are clipped
    to the environment's bounds.

    Returns:
        A sentence on the data that the run learns from, or a warning that it will learn nothing,
        or an empty text; and whether transitions that the run collects are added to the buffer.

    Raises:
        ValueError: If ``dataset.alone`` is true without a path; if transitions do not fit the
            environment, lack an entry or are not finite; if no episode is within the limits, or
            the replay buffer is too small.
    """
    node = config.get("dataset")
    if node is None or node.path is None:
        if node is not None and node.alone:
            raise ValueError(
                f"dataset.path is missing: algo={config.algo.name} with dataset.alone=true learns "
                "from nothing else. Give the folder of a recording (record=true), or an HDF5 file."
            )
        random_steps = setting(config, "exploration.random_steps")
        warning = (
            f"Nothing will be learned: exploration.random_steps={random_steps} come first, and the "
            f"run has {config.frames:,}."
        )
        return warning if config.frames < random_steps else "", True
    limits = check_cost_limits(config.cost_limits, env.cost_keys)
    learns_from = _fill(buffer, node, limits, env, bounded_actions(env))
    return learns_from + _other_environment(config), not node.alone


def _other_environment(config: DictConfig) -> str:
    """A warning if a recording is in the folder of a run of another environment; else empty."""
    try:
        name = read_config(Path(config.dataset.path).parent / "config.yaml")["env"]["name"]
    except (OSError, ValueError, LookupError, TypeError):  # it is not in a run's folder
        return ""
    own = config.env.name
    return "" if name == own else f" Warning: they are of {name}, and this environment is {own}."


def _fill(
    buffer: Memory, node: DictConfig, limits: Mapping[str, float], env: EnvBase, actions: TensorSpec
) -> str:
    """Put the transitions of a dataset into a replay buffer; return a sentence on them."""
    steps = read_dataset(node.path)
    _check(steps, node, buffer, env, actions)
    number = steps.batch_size.numel()
    if node.safe_episodes:
        if missing := [key for key in limits if ("next", key) not in steps.keys(True)]:
            raise ValueError(
                f"dataset.path={node.path} has no {', '.join(missing)}, which cost_limits names."
            )
        _check_finite(steps, node, [("next", key) for key in limits])
        steps = safe_episodes(steps, limits)
    taken = steps.batch_size.numel()
    if not 0 < taken <= buffer.capacity:
        what = " in whole episodes that keep cost_limits" if node.safe_episodes else ""
        raise ValueError(
            f"dataset.path={node.path}: of its {number:,} transitions {taken:,} are taken"
            f"{what}. There must be some, and room for them: memory.capacity={buffer.capacity}."
        )
    _check_finite(steps, node, buffer.in_keys)
    steps["action"] = steps["action"].clamp(actions.low.cpu(), actions.high.cpu())
    buffer.extend(steps)
    buffer.end_rows()
    kept = "those of whole episodes that keep the limits" if node.safe_episodes else "all"
    return f"Learning from {taken:,} of {number:,} transitions in {node.path}: {kept}."


def _check(
    steps: TensorDictBase, node: DictConfig, buffer: Memory, env: EnvBase, actions: TensorSpec
) -> None:
    """Refuse transitions of another environment, or without an entry that the loss reads."""
    if missing := [_name(key) for key in buffer.in_keys if key not in steps.keys(True)]:
        raise ValueError(
            f"dataset.path={node.path} has no {', '.join(missing)}, which is learned from."
        )
    sizes = {
        "observation": env.observation_spec["observation"].shape[-1],
        "action": actions.shape[-1],
    }
    for key, size in sizes.items():
        if steps[key].shape[-1] != size:
            raise ValueError(
                f"dataset.path={node.path}: its {key}s are {steps[key].shape[-1]} numbers, those "
                f"of this environment {size}. It is a dataset of another one."
            )


def _check_finite(steps: TensorDictBase, node: DictConfig, keys: Sequence[NestedKey]) -> None:
    """Refuse NaN and infinity, which would look like diverged training, or like a cost of 0."""
    for key in keys:
        if wrong := int((~steps[key].isfinite()).any(-1).sum()):
            raise ValueError(
                f"dataset.path={node.path}: the {_name(key)} of {wrong:,} transitions is not "
                "finite. Remove their episodes, or repair the file."
            )


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]
