"""The robots, the configuration of one environment, and the names of the family's environments.

`RUNNERS` has a row per robot, with all differences between Gymnasium's environments. MJCF files,
frame skips, weights, ranges and noise are the defaults of Gymnasium's environments of version 5;
velocity thresholds are those of Safety-Gymnasium 1.0 (Ji et al. 2023, `v1`), half the speed of a
robot trained with PPO.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, get_type_hints

from safe_rl.envs.errors import ConfigError, on_cpu_only
from safe_rl.envs.physics.dynamics import SCALES
from safe_rl.naming import did_you_mean
from safe_rl.ranges import Count, NotNegative, Number, Positive, Values, values_of

PARTS = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
"""What may be observed besides positions and velocities, in this order."""


@dataclass(frozen=True, kw_only=True)
class Runner:
    """One robot.

    Attributes:
        gymnasium_id: The environment with the same dynamics, observation and reward.
        mjcf: The robot's file among Gymnasium's assets.
        place: The point whose velocity is limited, a key of `locomotion.PLACES`.
        num_hidden: Leading positions that `exclude_current_positions_from_observation` hides.
        velocity_limit: Observed joint velocities are clipped to plus and minus this [m/s, rad/s].
        normal_velocities: Whether initial velocities are normally distributed, not uniformly.
        defaults: The robot's configuration keys and their values.
    """

    gymnasium_id: str
    mjcf: str
    place: str
    num_hidden: int
    velocity_limit: float = math.inf
    normal_velocities: bool = False
    defaults: Mapping[str, Any]


def _keys(**own: Any) -> Mapping[str, Any]:
    common: dict[str, Any] = {
        "num_steps": 1000,
        "forward_reward_weight": 1.0,
        "exclude_current_positions_from_observation": True,
        **dict.fromkeys(SCALES, 1.0),
    }
    return MappingProxyType(common | own)


def _standing(z: tuple[float, float], reward: float = 1.0) -> dict[str, Any]:
    """Keys of the robots that can fall."""
    return {"healthy_reward": reward, "terminate_when_unhealthy": True, "healthy_z_range": z}


RUNNERS: Mapping[str, Runner] = {
    "half_cheetah": Runner(
        gymnasium_id="HalfCheetah-v5", mjcf="half_cheetah.xml", place="x", num_hidden=1,
        normal_velocities=True,
        defaults=_keys(velocity_threshold=3.2096, frame_skip=5, ctrl_cost_weight=0.1,
                       reset_noise_scale=0.1)),
    "hopper": Runner(
        gymnasium_id="Hopper-v5", mjcf="hopper.xml", place="x", num_hidden=1,
        velocity_limit=10.0,
        defaults=_keys(velocity_threshold=0.7402, frame_skip=4, ctrl_cost_weight=1e-3,
                       reset_noise_scale=5e-3, **_standing((0.7, math.inf)),
                       healthy_angle_range=(-0.2, 0.2), healthy_state_range=(-100.0, 100.0))),
    "walker2d": Runner(
        gymnasium_id="Walker2d-v5", mjcf="walker2d_v5.xml", place="x", num_hidden=1,
        velocity_limit=10.0,
        defaults=_keys(velocity_threshold=2.3415, frame_skip=4, ctrl_cost_weight=1e-3,
                       reset_noise_scale=5e-3, **_standing((0.8, 2.0)),
                       healthy_angle_range=(-1.0, 1.0))),
    "ant": Runner(
        gymnasium_id="Ant-v5", mjcf="ant.xml", place="torso", num_hidden=2,
        normal_velocities=True,
        defaults=_keys(velocity_threshold=2.6222, frame_skip=5, ctrl_cost_weight=0.5,
                       reset_noise_scale=0.1, **_standing((0.2, 1.0)), contact_cost_weight=5e-4,
                       contact_force_range=(-1.0, 1.0), include_cfrc_ext_in_observation=True)),
    "swimmer": Runner(
        gymnasium_id="Swimmer-v5", mjcf="swimmer.xml", place="x", num_hidden=2,
        defaults=_keys(velocity_threshold=0.2282, frame_skip=4, ctrl_cost_weight=1e-4,
                       reset_noise_scale=0.1)),
    "humanoid": Runner(
        gymnasium_id="Humanoid-v5", mjcf="humanoid.xml", place="centre_of_mass", num_hidden=2,
        defaults=_keys(velocity_threshold=1.4149, frame_skip=5, ctrl_cost_weight=0.1,
                       reset_noise_scale=1e-2, **_standing((1.0, 2.0), reward=5.0),
                       contact_cost_weight=5e-7, contact_cost_range=(-math.inf, 10.0),
                       **{f"include_{part}_in_observation": True for part in PARTS},
                       forward_reward_weight=1.25)),
}  # fmt: skip


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
    those of Gymnasium's environments of version 5 (Towers et al. 2024). Use `from_dict`, which adds
    the robot's defaults.

    Raises:
        ConfigError: If a value has the wrong type or is out of range.

    Examples:
        >>> config = VelocityConfig.from_dict({"robot": "hopper", "velocity_threshold": 1.0})
        >>> config.replace(frame_skip=2).frame_skip, config.healthy_angle_range
        (2, (-0.2, 0.2))
    """

    robot: str
    velocity_threshold: NotNegative  # m/s; faster costs 1
    num_steps: Count  # of an episode
    frame_skip: Count  # substeps per step
    # Factors on the values in Gymnasium's file. Friction cannot be 0 in MuJoCo.
    mass_scale: Positive
    friction_scale: Positive
    damping_scale: NotNegative  # of joints
    strength_scale: NotNegative  # of actuators
    reset_noise_scale: NotNegative  # of positions [m, rad] and velocities [m/s, rad/s]
    exclude_current_positions_from_observation: bool
    include_cinert_in_observation: bool | None = None
    include_cvel_in_observation: bool | None = None
    include_qfrc_actuator_in_observation: bool | None = None
    include_cfrc_ext_in_observation: bool | None = None

    # reward
    forward_reward_weight: Number  # per m/s
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
            value, values = getattr(self, key), _VALUES[key]
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


_ANNOTATIONS = get_type_hints(VelocityConfig, include_extras=True)
_VALUES = {key: values_of(annotation) for key, annotation in _ANNOTATIONS.items()}

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
