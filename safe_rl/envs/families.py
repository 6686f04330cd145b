"""Families of environments: from a node of the configuration, or a name, to an environment.

The key `_target_` of a node names its family: a function or class that is called with the node's
other keys, and `num_envs`, `device`, `seed` and `num_threads`. A node without one is Safety Gym's.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import torch

from safe_rl.envs.contract import ConstrainedEnv, check_constrained_env
from safe_rl.envs.gymnasium.family import GYMNASIUM_TARGET, complete_gymnasium
from safe_rl.envs.safety_gym.env import SafetyGymEnv
from safe_rl.envs.safety_gym.nodes import complete_safety_gym, safety_gym_node
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE
from safe_rl.envs.transforms.environment import transform_env
from safe_rl.envs.velocity.nodes import VELOCITY_TARGET, complete_velocity, velocity_node
from safe_rl.envs.velocity.suite import VELOCITY_SUITE
from safe_rl.targets import locate


class Named(NamedTuple):
    """Names of a family, and the node that each of them stands for."""

    names: Callable[[], Collection[str]]
    node: Callable[[str], dict[str, Any]]


NAMED = [
    Named(lambda: [*SUITE, *EXTRAS], safety_gym_node),
    Named(lambda: list(VELOCITY_SUITE), velocity_node),
]

# What fills a family's nodes up; others are taken as they are.
_COMPLETE: dict[str | None, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    None: complete_safety_gym,
    VELOCITY_TARGET: complete_velocity,
    GYMNASIUM_TARGET: complete_gymnasium,
}


def env_names() -> list[str]:
    """Names that stand for an environment of any family."""
    return [name for family in NAMED for name in family.names()]


def env_node(name: str) -> dict[str, Any]:
    """Return the node of the group `env` that a name stands for, with every key.

    Raises:
        KeyError: if there is no such name.

    Examples:
        >>> env_node("CarPush2")["pillars_num"]
        4
    """
    for family in NAMED:
        if name in family.names():
            return family.node(name)
    raise KeyError(name)


def complete_env(node: Mapping[str, Any]) -> dict[str, Any]:
    """Fill up a node that holds only what differs from its family's defaults.

    Args:
        node: as `make_env` takes it; what it holds stays as it is.

    Raises:
        ConfigError: for an unknown key or a value that cannot be used.

    Examples:
        >>> complete_env({"name": "mine", "robot_base": "point"})["randomize_layout"]
        True
    """
    complete = _COMPLETE.get(node.get("_target_"))
    return dict(node) if complete is None else complete(node)


def make_env(
    env: str | Mapping[str, Any] | SafetyGymConfig,
    *,
    num_envs: int = 1,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
    transforms: Mapping[str, Any] | None = None,
    evaluating: bool = False,
) -> ConstrainedEnv:
    """Make a batch of environments of any family.

    Args:
        env: a name, a configuration of Safety Gym, or a node of the group `env`: `name`, `_target_`
            and the family's keys.
        num_envs: number of environments, N.
        device: where the TensorDicts live.
        seed: determines every draw; None takes one from torch's generator.
        num_threads: threads that may step them; 0 for one per core.
        transforms: name -> transform, or its node, as `transform_env` takes them.
        evaluating: whether the transforms undo what only serves learning.

    Raises:
        ConfigError: for an unknown name or key, or a value that cannot be used.
        TargetError: for a family that configurations must not reach.
        ContractError: for a family of one's own whose environments lack something.

    Examples:
        >>> make_env({"name": "mine", "robot_base": "point"}, num_envs=2).batch_size
        torch.Size([2])
    """
    if isinstance(env, str) and env in env_names():
        env = env_node(env)
    target = env.get("_target_") if isinstance(env, Mapping) else None
    build = SafetyGymEnv if target is None else locate(target, key="env._target_")
    if isinstance(env, Mapping):
        env = {key: value for key, value in env.items() if key not in ("_target_", "name")}
    made = build(env, num_envs=num_envs, device=device, seed=seed, num_threads=num_threads)
    if transforms:
        made = transform_env(made, transforms, evaluating=evaluating)
    if target is not None or transforms:
        check_constrained_env(made)
    return made
