"""The family's names, and the one way from a name to a configuration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.robots import ROBOTS

VELOCITY_SUITE: dict[str, VelocityConfig] = {
    f"Safe{row.gymnasium_id.removesuffix('-v5')}Velocity": VelocityConfig.from_dict({"robot": name})
    for name, row in ROBOTS.items()
}


def resolve_velocity(env: str | Mapping[str, Any] | VelocityConfig) -> VelocityConfig:
    """Return the configuration of a name, a mapping of keys, or a configuration.

    Args:
        env: "SafeHopperVelocity", Safety-Gymnasium's "SafetyHopperVelocity-v1", a mapping with
            `robot` and any of its keys, or a `VelocityConfig`.

    Raises:
        ConfigError: for an unknown name (the nearest one is named), or an invalid configuration.

    Examples:
        >>> resolve_velocity("SafetyAntVelocity-v1").velocity_threshold
        2.6222
    """
    if isinstance(env, VelocityConfig):
        return env
    if isinstance(env, Mapping):
        return VelocityConfig.from_dict(env)
    if not isinstance(env, str):
        raise ConfigError(
            "An environment is a name, a mapping of configuration keys or a VelocityConfig, got "
            f"{type(env).__name__}."
        )
    name = env.removesuffix("-v1")
    if name.startswith("Safety"):
        name = f"Safe{name.removeprefix('Safety')}"
    if name not in VELOCITY_SUITE:
        raise ConfigError(
            f"Unknown environment '{env}'.{nearest(name, VELOCITY_SUITE)} The velocity family has "
            f"{', '.join(VELOCITY_SUITE)}."
        )
    return VELOCITY_SUITE[name]
