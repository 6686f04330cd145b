"""The family's configurations as nodes of Hydra's group `env`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.suite import VELOCITY_SUITE, resolve_velocity

VELOCITY_TARGET = "safe_rl.envs.velocity.VelocityEnv"


def velocity_node(name: str, config: VelocityConfig | None = None) -> dict[str, Any]:
    """Return a configuration as a node: `name`, the family, and keys as YAML has them.

    Args:
        name: of the environment.
        config: its configuration; None takes the family's own of that name.

    Examples:
        >>> velocity_node("SafeHopperVelocity")["healthy_angle_range"]
        [-0.2, 0.2]
    """
    values = (VELOCITY_SUITE[name] if config is None else config).to_dict().items()
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in values}
    return {"name": name, "_target_": VELOCITY_TARGET, **plain}


def complete_velocity(node: Mapping[str, Any]) -> dict[str, Any]:
    """Add the defaults of the keys that a node lacks; those it has stay as they are written.

    Raises:
        ConfigError: for an unknown key or a value that cannot be used.
    """
    keys = {key: value for key, value in node.items() if key not in ("name", "_target_")}
    return {**velocity_node(node.get("name", "custom"), resolve_velocity(keys)), **node}
