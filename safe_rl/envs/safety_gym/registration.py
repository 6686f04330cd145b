"""The suite's names in Hydra and in Gymnasium, and environments from what Hydra composes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
from hydra.core.config_store import ConfigStore

from safe_rl.envs.safety_gym.env import SafetyGymEnv
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, resolve


def _plain(value: Any) -> Any:
    """Turn tuples into lists: Hydra knows no tuples."""
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def group_node(name: str, config: SafetyGymConfig) -> dict[str, Any]:
    """Return a configuration as a node of Hydra's group `env`: every key, and `name`."""
    return {"name": name, **{key: _plain(value) for key, value in config.to_dict().items()}}


def store_config(name: str, config: Mapping[str, Any] | SafetyGymConfig) -> None:
    """Put a configuration into Hydra's group `env` by a name, so that `env=<name>` finds it.

    Raises:
        ConfigError: for an unknown key, or a value that cannot be used.
    """
    node = group_node(name, resolve(config))
    ConfigStore.instance().store(group="env", name=name, node=node)


def store_configs() -> None:
    """Put all names into Hydra's group `env`, so that `env=PointGoal1 env.hazards_num=3` works."""
    for name, config in (SUITE | EXTRAS).items():
        store_config(name, config)


def register_gymnasium() -> None:
    """Give Gymnasium an id `Safexp-{name}-v0` for every name, and `Safexp-Custom-v0`.

    The custom one has the defaults of every configuration key; all of them take a `config` with
    keys to change. What the ids stand for is imported when an environment is made.
    """
    for name in (*SUITE, *EXTRAS, None):
        env_id = f"Safexp-{name or 'Custom'}-v0"
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="safe_rl.envs.gymnasium.single:SafetyGymnasiumEnv",
                vector_entry_point="safe_rl.envs.gymnasium.vector:SafetyGymnasiumVectorEnv",
                kwargs={"name": name},
            )


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
