"""The configuration of one environment, and the names of the family's environments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, get_type_hints

from safe_rl.envs.errors import ConfigError, on_cpu_only
from safe_rl.envs.velocity.runners import RUNNERS
from safe_rl.naming import did_you_mean
from safe_rl.ranges import Count, NotNegative, Number, Positive, Values, values_of


def _is_interval(value: Any) -> bool:
    """Whether a value is a pair of ordered numbers, which may be infinite."""
    is_pair = isinstance(value, list | tuple) and len(value) == 2
    are_numbers = is_pair and all(type(bound) in (int, float) for bound in value)
    return are_numbers and value[0] <= value[1]


Interval = Annotated[
    tuple[float, float],
    Values(_is_interval, "a list of two numbers (lowest, highest) with lowest <= highest"),
]


@dataclass(frozen=True, kw_only=True)
class VelocityConfig:
    """Everything that defines one environment; keys that its robot does not have are None.

    Except `robot`, `velocity_threshold`, `num_steps` and the scales of the dynamics, the keys are
    those of Gymnasium's environments of version 5 (Towers et al. 2024). `from_dict` adds the
    robot's defaults.

    Raises:
        ConfigError: If a value has the wrong type or is out of range.

    Examples:
        >>> config = VelocityConfig.from_dict({"robot": "hopper", "velocity_threshold": 1.0})
        >>> config.replace(frame_skip=2).frame_skip, config.healthy_angle_range
        (2, (-0.2, 0.2))
    """

    robot: str
    velocity_threshold: NotNegative  # m/s; faster costs 1
    num_steps: Count = 1000  # of an episode
    frame_skip: Count  # substeps per step
    # Factors on the values in Gymnasium's file. Friction cannot be 0 in MuJoCo.
    mass_scale: Positive = 1.0
    friction_scale: Positive = 1.0
    damping_scale: NotNegative = 1.0  # of joints
    strength_scale: NotNegative = 1.0  # of actuators
    reset_noise_scale: NotNegative  # of positions [m, rad] and velocities [m/s, rad/s]
    exclude_current_positions_from_observation: bool = True
    include_cinert_in_observation: bool | None = None
    include_cvel_in_observation: bool | None = None
    include_qfrc_actuator_in_observation: bool | None = None
    include_cfrc_ext_in_observation: bool | None = None

    # reward
    forward_reward_weight: Number = 1.0  # per m/s
    ctrl_cost_weight: Number  # per squared control
    contact_cost_weight: Number | None = None  # per squared force [N², N²m²]
    contact_cost_range: Interval | None = None  # of the weighted sum
    contact_force_range: Interval | None = None  # of every force [N, N m]
    healthy_reward: Number | None = None

    # what ends an episode
    terminate_when_unhealthy: bool | None = None
    healthy_z_range: Interval | None = None  # height of the torso [m]
    healthy_angle_range: Interval | None = None  # of the torso [rad]
    healthy_state_range: Interval | None = None  # of all other positions and velocities

    def __post_init__(self) -> None:
        _check_keys(self.robot, self.to_dict())
        for key, default in RUNNERS[self.robot].defaults.items():
            value, values = getattr(self, key), _values(key)
            if value is None or not values.hold(value):
                raise ConfigError(
                    f"Configuration key '{key}' must be {values.words.removesuffix(', or null')}, "
                    f"got {value!r}."
                )
            kind = type(default)
            value = tuple(map(float, value)) if kind is tuple else kind(value)
            object.__setattr__(self, key, value)

    @classmethod
    def from_dict(cls, keys: Mapping[str, Any]) -> VelocityConfig:
        """Make a configuration from a robot's defaults and other values for some keys.

        Raises:
            ConfigError: For an unknown robot or key, or a value that cannot be used.
        """
        if "robot" not in keys:
            raise ConfigError(f"The configuration lacks 'robot', one of {list(RUNNERS)}.")
        _check_keys(keys["robot"], keys)
        return cls(**{**RUNNERS[keys["robot"]].defaults, **keys})

    def replace(self, **changes: Any) -> VelocityConfig:
        """Return a copy with some keys changed; another `robot` starts from its own defaults."""
        if changes.get("robot", self.robot) != self.robot:
            return VelocityConfig.from_dict(changes)
        return VelocityConfig.from_dict(self.to_dict() | changes)

    def to_dict(self) -> dict[str, Any]:
        """Return the keys that the robot has, and their values."""
        return {key: value for key, value in vars(self).items() if value is not None}


def _check_keys(robot: Any, given: Any) -> None:
    if not isinstance(robot, str) or robot not in RUNNERS:
        hint = did_you_mean(robot, RUNNERS) if isinstance(robot, str) else ""
        raise ConfigError(f"'robot' must be one of {list(RUNNERS)}, got {robot!r}.{hint}")
    known = ["robot", *RUNNERS[robot].defaults]
    for key in given:
        if key not in known:
            hint = on_cpu_only(key) or f"{did_you_mean(str(key), known)} It has {sorted(known)}."
            raise ConfigError(f"Robot '{robot}' has no configuration key '{key}'.{hint}")


@cache
def _values(key: str) -> Values:
    """Return the values that a key may have."""
    return values_of(get_type_hints(VelocityConfig, include_extras=True)[key])


VELOCITY_SUITE: dict[str, VelocityConfig] = {
    f"Safe{row.gymnasium_id.removesuffix('-v5')}Velocity": VelocityConfig.from_dict({"robot": name})
    for name, row in RUNNERS.items()
}


def resolve_velocity(env: str | Mapping[str, Any] | VelocityConfig) -> VelocityConfig:
    """Return the configuration of a name, a mapping of keys, or a configuration.

    Args:
        env: "SafeHopperVelocity", Safety-Gymnasium's "SafetyHopperVelocity-v1", a mapping with
            `robot` and any of its keys, or a `VelocityConfig`.

    Raises:
        ConfigError: For an unknown name (the nearest one is named), or an invalid configuration.
    """
    if isinstance(env, VelocityConfig):
        return env
    if isinstance(env, Mapping):
        return VelocityConfig.from_dict(env)
    name = env.removesuffix("-v1")
    if name.startswith("Safety"):
        name = f"Safe{name.removeprefix('Safety')}"
    if name not in VELOCITY_SUITE:
        raise ConfigError(
            f"Unknown environment '{env}'.{did_you_mean(name, VELOCITY_SUITE)} The velocity family "
            f"has {', '.join(VELOCITY_SUITE)}."
        )
    return VELOCITY_SUITE[name]
