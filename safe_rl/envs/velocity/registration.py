"""The family's names in Hydra, and environments from what Hydra composes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hydra.core.config_store import ConfigStore

from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.env import VelocityEnv
from safe_rl.envs.velocity.suite import VELOCITY_SUITE


def velocity_node(name: str, config: VelocityConfig) -> dict[str, Any]:
    """Return a configuration as a node of Hydra's group `env`: `name`, and keys as YAML has them.

    Examples:
        >>> velocity_node("mine", VELOCITY_SUITE["SafeHopperVelocity"])["healthy_angle_range"]
        [-0.2, 0.2]
    """
    values = config.to_dict().items()
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in values}
    return {"name": name, **plain}


def store_velocity_configs() -> None:
    """Put all names into Hydra's group `env`: `env=SafeHopperVelocity env.frame_skip=2`."""
    for name, config in VELOCITY_SUITE.items():
        ConfigStore.instance().store(group="env", name=name, node=velocity_node(name, config))


def make_velocity_env(env: str | Mapping[str, Any] | VelocityConfig, **kwargs: Any) -> VelocityEnv:
    """Make an environment from a name, a configuration, or a node of the group `env`.

    Args:
        env: as `VelocityEnv` takes it; a mapping may also have the node's `name`.
        kwargs: further arguments of `VelocityEnv`.

    Raises:
        ConfigError: for an unknown name or key, or a value that cannot be used.

    Examples:
        >>> make_velocity_env({"name": "mine", "robot": "swimmer"}, num_envs=2).batch_size
        torch.Size([2])
    """
    if isinstance(env, Mapping):
        env = {key: value for key, value in env.items() if key != "name"}
    return VelocityEnv(env, **kwargs)
