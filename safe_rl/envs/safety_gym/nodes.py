"""Safety Gym's configurations as nodes of Hydra's group `env`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, resolve


def _plain(value: Any) -> Any:
    """Turn tuples into lists: Hydra knows no tuples."""
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def group_node(name: str, config: SafetyGymConfig) -> dict[str, Any]:
    """Return a configuration as a node of Hydra's group `env`: every key, and `name`."""
    return {"name": name, **{key: _plain(value) for key, value in config.to_dict().items()}}


def safety_gym_node(name: str) -> dict[str, Any]:
    """Return the node of a name in the suite, or beside it."""
    return group_node(name, (SUITE | EXTRAS)[name])


def complete_safety_gym(node: Mapping[str, Any]) -> dict[str, Any]:
    """Add the defaults of the keys that a node lacks; those it has stay as they are written.

    Raises:
        ConfigError: for an unknown key or a value that cannot be used.
    """
    config = resolve({key: value for key, value in node.items() if key not in ("name", "_target_")})
    return {**group_node(node.get("name", "custom"), config), **node}
