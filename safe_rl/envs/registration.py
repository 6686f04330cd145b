"""The suite's names in Hydra, and environments from what Hydra composes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hydra.core.config_store import ConfigStore

from safe_rl.envs.config import SafetyGymConfig
from safe_rl.envs.safety_gym import SafetyGymEnv
from safe_rl.envs.suite import SUITE


def _plain(value: Any) -> Any:
    """Turn tuples into lists: Hydra knows no tuples."""
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def group_node(name: str, config: SafetyGymConfig) -> dict[str, Any]:
    """Return a configuration as a node of Hydra's group `env`: every key, and `name`."""
    return {"name": name, **{key: _plain(value) for key, value in config.to_dict().items()}}


def store_configs() -> None:
    """Put the suite into Hydra's group `env`, so that `env=PointGoal1 env.hazards_num=3` works."""
    store = ConfigStore.instance()
    for name, config in SUITE.items():
        store.store(group="env", name=name, node=group_node(name, config))


def make_env(env: str | Mapping[str, Any] | SafetyGymConfig, **kwargs: Any) -> SafetyGymEnv:
    """Make an environment from a suite name, a configuration, or a node of the group `env`.

    Args:
        env: as `SafetyGymEnv` takes it; a mapping may also have the node's `name`.
        kwargs: further arguments of `SafetyGymEnv`.

    Raises:
        ConfigError: for an unknown name or key, or a value that cannot be used.

    Examples:
        >>> make_env({"name": "mine", "robot_base": "point"}, num_envs=2).batch_size
        torch.Size([2])
    """
    if isinstance(env, Mapping):
        env = {key: value for key, value in env.items() if key != "name"}
    return SafetyGymEnv(env, **kwargs)
