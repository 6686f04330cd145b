"""Make a batch of environments of any family from a name, or a node of the configuration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from inspect import signature
from typing import Any

import torch

from safe_rl.envs.contract import ConstrainedEnv, ContractError, check_constrained_env
from safe_rl.envs.errors import ConfigError
from safe_rl.envs.families import env_node
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.env import SafetyGymEnv
from safe_rl.envs.transforms.environment import transform_env
from safe_rl.envs.velocity.velocity_config import VelocityConfig
from safe_rl.naming import did_you_mean
from safe_rl.trust import locate


def make_env(
    env: str | Mapping[str, Any] | SafetyGymConfig | VelocityConfig,
    *,
    num_envs: int = 1,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
    transforms: Mapping[str, Any] | None = None,
    evaluating: bool = False,
    **keys: Any,
) -> ConstrainedEnv:
    """Make a batch of environments of any family.

    Args:
        env: A name, also one from `store_config`; a configuration of Safety Gym or of the velocity
            family; or a node of the group `env`: `name`, `_target_` and the family's keys.
        num_envs: Number of environments, N.
        device: Device of the TensorDicts.
        seed: Determines every random draw; None takes a seed from torch's generator.
        num_threads: Largest number of threads that step them; 0 for one per core.
        transforms: Name -> transform, or its node, as `transform_env` takes them.
        evaluating: Whether policies are evaluated; transforms that only help learning are then off.
        keys: Keys of the environment to change, such as ``hazards_num=12``.

    Raises:
        ConfigError: For an unknown name or key, or a value that cannot be used.
        TargetError: For a family whose target a configuration may not name.
        ContractError: If an environment of the user's family does not fulfil the contract.

    Examples:
        >>> make_env("PointGoal1", num_envs=2, hazards_num=12).config.hazards_num
        12
        >>> make_env({"name": "mine", "robot_base": "point"}, num_envs=2).batch_size
        torch.Size([2])
    """
    given: dict[str, Any] = {
        "num_envs": num_envs, "device": device, "seed": seed, "num_threads": num_threads
    }  # fmt: skip
    node = dict(env if isinstance(env, Mapping) else env_node(env))
    for key in keys.keys() - node.keys():
        if meant := did_you_mean(key, [*given, "transforms"], 0.85):
            raise ConfigError(f"There is no argument '{key}'.{meant}")
    node |= keys
    target = node.pop("_target_", None)
    node.pop("name", None)
    build = SafetyGymEnv if target is None else locate(target, key="env._target_")
    if target is not None:
        _check_arguments(build, target, node, given)
    made = build(node, **given)
    if transforms:
        made = transform_env(made, transforms, evaluating=evaluating, seed=seed)
    if target is not None or transforms:
        check_constrained_env(made)
    if list(made.batch_size) != [num_envs]:
        raise ContractError(
            f"{target} made {made.batch_size[0]} environments instead of {num_envs}: it must make "
            "'num_envs' of them."
        )
    return made


def _check_arguments(
    build: Callable[..., Any], target: str, env: Any, given: Mapping[str, Any]
) -> None:
    """Refuse a function that does not take what every family is given."""
    try:
        signature(build).bind(env, **given)
    except TypeError as error:
        raise ContractError(
            f"{target}: {error}. It is called with the keys of env as the first argument, and with "
            f"{', '.join(given)} by name."
        ) from None
