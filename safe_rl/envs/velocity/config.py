"""The configuration of one environment: a robot, its velocity threshold, and Gymnasium's keys."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.physics.dynamics import SCALES
from safe_rl.envs.velocity.robots import ROBOTS

Range = tuple[float, float]
_SCALES = ("reset_noise_scale", *SCALES)


@dataclass(frozen=True, kw_only=True)
class VelocityConfig:
    """Everything that defines one environment; keys that its robot does not have are None.

    Keys are those of Gymnasium's environments of version 5 (Towers et al. 2024), but for `robot`,
    `velocity_threshold`, `num_steps` and the scales of the dynamics. `from_dict` fills in what is
    not given.

    Raises:
        ConfigError: if a value has the wrong type or is out of range.

    Examples:
        >>> config = VelocityConfig.from_dict({"robot": "hopper", "velocity_threshold": 1.0})
        >>> config.replace(frame_skip=2).frame_skip, config.healthy_angle_range
        (2, (-0.2, 0.2))
    """

    robot: str
    velocity_threshold: float  # m/s; faster costs 1
    num_steps: int = 1000  # of an episode
    frame_skip: int  # substeps per step
    # factors on what Gymnasium's file says
    mass_scale: float = 1.0
    friction_scale: float = 1.0
    damping_scale: float = 1.0  # of joints
    strength_scale: float = 1.0  # of actuators
    reset_noise_scale: float  # of positions [m, rad] and velocities [m/s, rad/s]
    exclude_current_positions_from_observation: bool = True
    include_cinert_in_observation: bool | None = None
    include_cvel_in_observation: bool | None = None
    include_qfrc_actuator_in_observation: bool | None = None
    include_cfrc_ext_in_observation: bool | None = None

    # reward
    forward_reward_weight: float = 1.0  # per m/s
    ctrl_cost_weight: float  # per squared control
    contact_cost_weight: float | None = None  # per squared force [N², N²m²]
    contact_cost_range: Range | None = None  # of the weighted sum
    contact_force_range: Range | None = None  # of every force [N, N m]
    healthy_reward: float | None = None

    # what ends an episode
    terminate_when_unhealthy: bool | None = None
    healthy_z_range: Range | None = None  # height of the torso [m]
    healthy_angle_range: Range | None = None  # of the torso [rad]
    healthy_state_range: Range | None = None  # of all other positions and velocities

    def __post_init__(self) -> None:
        _check_keys(self.robot, [key for key, value in _items(self) if value is not None])
        for key, default in ROBOTS[self.robot].defaults.items():
            object.__setattr__(self, key, _coerce(key, getattr(self, key), default))

    @classmethod
    def from_dict(cls, keys: Mapping[str, Any]) -> VelocityConfig:
        """Make a configuration of a robot's defaults and other values for some keys.

        Args:
            keys: `robot`, and any of that robot's keys.

        Raises:
            ConfigError: for an unknown robot or key, or a value that cannot be used.
        """
        if "robot" not in keys:
            raise ConfigError(f"The configuration lacks 'robot', one of {list(ROBOTS)}.")
        given = {key: value for key, value in keys.items() if key != "robot"}
        _check_keys(keys["robot"], given)
        return cls(robot=keys["robot"], **(dict(ROBOTS[keys["robot"]].defaults) | given))

    def replace(self, **changes: Any) -> VelocityConfig:
        """Return a copy with some keys changed; another `robot` brings its own other keys.

        Raises:
            ConfigError: as `from_dict`.
        """
        if changes.get("robot", self.robot) != self.robot:
            return VelocityConfig.from_dict(changes)
        return VelocityConfig.from_dict(self.to_dict() | changes)

    def to_dict(self) -> dict[str, Any]:
        """Return the keys that the robot has, and their values."""
        return {key: value for key, value in _items(self) if value is not None}


def _items(config: VelocityConfig) -> list[tuple[str, Any]]:
    return [(field.name, getattr(config, field.name)) for field in dataclasses.fields(config)]


def _check_keys(robot: Any, given: Any) -> None:
    if not isinstance(robot, str) or robot not in ROBOTS:
        hint = nearest(robot, ROBOTS) if isinstance(robot, str) else ""
        raise ConfigError(f"'robot' must be one of {list(ROBOTS)}, got {robot!r}.{hint}")
    known = ["robot", *ROBOTS[robot].defaults]
    for key in given:
        if key not in known:
            raise ConfigError(
                f"Robot '{robot}' has no configuration key '{key}'.{nearest(str(key), known)} "
                f"It has {sorted(known)}."
            )


def _coerce(key: str, value: Any, default: Any) -> Any:
    """Return a value as the type of the robot's default, within the key's range."""
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise _wrong(key, "True or False", value)
        return value
    if isinstance(default, tuple):
        return _interval(key, value)
    number = _number(key, value)
    if isinstance(default, int):
        if not number.is_integer() or number < 1:
            raise _wrong(key, "an integer of at least 1", value)
        return int(number)
    if not math.isfinite(number):
        raise _wrong(key, "finite", value)
    if key in ("velocity_threshold", *_SCALES) and number < 0:
        raise _wrong(key, "0 or more", value)
    # MuJoCo has no surfaces without friction
    if key in ("mass_scale", "friction_scale") and number == 0:
        raise _wrong(key, "greater than 0", value)
    return number


def _interval(key: str, value: Any) -> Range:
    if isinstance(value, str | Mapping) or not hasattr(value, "__len__") or len(value) != 2:
        raise _wrong(key, "a list of two numbers (lowest, highest)", value)
    low, high = (_number(key, bound) for bound in value)
    if not low <= high:
        raise _wrong(key, "(lowest, highest) with lowest <= highest", value)
    return low, high


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise _wrong(key, "a number", value)
    return float(value)


def _wrong(key: str, wanted: str, value: Any) -> ConfigError:
    return ConfigError(f"Configuration key '{key}' must be {wanted}, got {value!r}.")
