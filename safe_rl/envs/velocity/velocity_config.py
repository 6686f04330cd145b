"""The robots, the configuration of one environment, and the names of the family's environments.

`RUNNERS` has a row per robot, with all differences between Gymnasium's environments. MJCF files,
frame skips, weights, ranges and noise are the defaults of Gymnasium's environments of version 5;
velocity thresholds are those of Safety-Gymnasium 1.0 (Ji et al. 2023, `v1`), half the speed of a
robot trained with PPO.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, get_type_hints

from pydantic import AllowInfNan

from safe_rl.checks import rule
from safe_rl.envs.keys import (
    Backend,
    ConfigError,
    Count,
    Factor,
    FactorOrZero,
    NotNegative,
    Number,
    Positive,
    check_key,
)
from safe_rl.naming import did_you_mean

PARTS = ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
"""What may be observed besides positions and velocities, in this order."""


@dataclass(frozen=True, kw_only=True)
class Runner:
    """One robot.

    Attributes:
        gymnasium_id: The environment with the same dynamics, observation and reward.
        mjcf: The robot's file among Gymnasium's assets.
        place: The point whose velocity is limited, a key of `runner.PLACES`.
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


_WALKER: Mapping[str, Any] = {"healthy_reward": 1.0, "terminate_when_unhealthy": True}
RUNNERS: Mapping[str, Runner] = {
    "half_cheetah": Runner(
        gymnasium_id="HalfCheetah-v5", mjcf="half_cheetah.xml", place="x", num_hidden=1,
        normal_velocities=True,
        defaults={"velocity_threshold": 3.2096, "frame_skip": 5, "reset_noise_scale": 0.1,
                  "forward_reward_weight": 1.0, "ctrl_cost_weight": 0.1}),
    "hopper": Runner(
        gymnasium_id="Hopper-v5", mjcf="hopper.xml", place="x", num_hidden=1, velocity_limit=10.0,
        defaults={"velocity_threshold": 0.7402, "frame_skip": 4, "reset_noise_scale": 5e-3,
                  "forward_reward_weight": 1.0, "ctrl_cost_weight": 1e-3, **_WALKER,
                  "healthy_z_range": (0.7, math.inf), "healthy_angle_range": (-0.2, 0.2),
                  "healthy_state_range": (-100.0, 100.0)}),
    "walker2d": Runner(
        gymnasium_id="Walker2d-v5", mjcf="walker2d_v5.xml", place="x", num_hidden=1,
        velocity_limit=10.0,
        defaults={"velocity_threshold": 2.3415, "frame_skip": 4, "reset_noise_scale": 5e-3,
                  "forward_reward_weight": 1.0, "ctrl_cost_weight": 1e-3, **_WALKER,
                  "healthy_z_range": (0.8, 2.0), "healthy_angle_range": (-1.0, 1.0)}),
    "ant": Runner(
        gymnasium_id="Ant-v5", mjcf="ant.xml", place="torso", num_hidden=2, normal_velocities=True,
        defaults={"velocity_threshold": 2.6222, "frame_skip": 5, "reset_noise_scale": 0.1,
                  "forward_reward_weight": 1.0, "ctrl_cost_weight": 0.5, **_WALKER,
                  "healthy_z_range": (0.2, 1.0), "contact_cost_weight": 5e-4,
                  "contact_force_range": (-1.0, 1.0), "include_cfrc_ext_in_observation": True}),
    "swimmer": Runner(
        gymnasium_id="Swimmer-v5", mjcf="swimmer.xml", place="x", num_hidden=2,
        defaults={"velocity_threshold": 0.2282, "frame_skip": 4, "reset_noise_scale": 0.1,
                  "forward_reward_weight": 1.0, "ctrl_cost_weight": 1e-4}),
    "humanoid": Runner(
        gymnasium_id="Humanoid-v5", mjcf="humanoid.xml", place="centre_of_mass", num_hidden=2,
        defaults={"velocity_threshold": 1.4149, "frame_skip": 5, "reset_noise_scale": 1e-2,
                  "forward_reward_weight": 1.25, "ctrl_cost_weight": 0.1, **_WALKER,
                  "healthy_reward": 5.0, "healthy_z_range": (1.0, 2.0),
                  "contact_cost_weight": 5e-7, "contact_cost_range": (-math.inf, 10.0),
                  **{f"include_{part}_in_observation": True for part in PARTS}}),
}  # fmt: skip


_Bound = Annotated[float, AllowInfNan()]
Interval = Annotated[
    tuple[_Bound, _Bound],
    rule(lambda pair: pair[0] <= pair[1], "an interval (lowest, highest) with lowest <= highest"),
]


_OF_ROBOT: Any = None  # replaced by the default of the robot, which every robot has


@dataclass(frozen=True, kw_only=True)
class VelocityConfig:
    """Everything that defines one environment; keys that its robot does not have are None.

    Except `robot`, `velocity_threshold`, `num_steps`, `physics`, `physics_buffers` and the scales
    of the dynamics, the keys are those of Gymnasium's environments of version 5 (Towers et al.
    2024). Use `from_dict`, which adds the robot's defaults.

    Raises:
        ConfigError: If a value has the wrong type or is out of range.

    Examples:
        >>> config = VelocityConfig.from_dict({"robot": "hopper", "velocity_threshold": 1.0})
        >>> config.replace(frame_skip=2).frame_skip, config.healthy_angle_range
        (2, (-0.2, 0.2))
    """

    robot: Annotated[str, "the robot"] = ""
    velocity_threshold: Annotated[NotNegative, "speed above which a step costs 1 [m/s]"] = _OF_ROBOT
    num_steps: Annotated[Count, "steps after which an episode is truncated"] = 1000
    frame_skip: Annotated[Count, "substeps per step"] = _OF_ROBOT
    physics: Annotated[Backend, "MuJoCo on the CPU, or MuJoCo Warp on the device"] = "cpu"
    physics_buffers: Annotated[Positive, "room for contacts on Warp, per contact in a trial"] = 2.0
    # Factors on the values in Gymnasium's file; two numbers: the range of one that is drawn for
    # every episode. Friction cannot be 0 in MuJoCo.
    mass_scale: Annotated[Factor, "factor on masses and inertias"] = 1.0
    friction_scale: Annotated[Factor, "factor on the friction of all surfaces"] = 1.0
    damping_scale: Annotated[FactorOrZero, "factor on the damping of joints"] = 1.0
    strength_scale: Annotated[FactorOrZero, "factor on the forces of actuators"] = 1.0
    reset_noise_scale: Annotated[
        NotNegative, "noise of initial positions [m, rad] and velocities [m/s, rad/s]"
    ] = _OF_ROBOT
    exclude_current_positions_from_observation: Annotated[bool, "hide the root's place"] = True
    include_cinert_in_observation: Annotated[bool | None, "observe masses and inertias"] = _OF_ROBOT
    include_cvel_in_observation: Annotated[bool | None, "observe the velocities of bodies"] = None
    include_qfrc_actuator_in_observation: Annotated[bool | None, "observe actuator forces"] = None
    include_cfrc_ext_in_observation: Annotated[bool | None, "observe contact forces"] = None

    # reward
    forward_reward_weight: Annotated[Number, "reward per m/s"] = _OF_ROBOT
    ctrl_cost_weight: Annotated[Number, "loss of reward per squared control"] = _OF_ROBOT
    contact_cost_weight: Annotated[Number | None, "the same per squared force [N², N²m²]"] = None
    contact_cost_range: Annotated[Interval | None, "range of the weighted sum"] = None
    contact_force_range: Annotated[Interval | None, "range of every force [N, N m]"] = None
    healthy_reward: Annotated[Number | None, "reward per step of a healthy robot"] = None

    # what ends an episode
    terminate_when_unhealthy: Annotated[bool | None, "whether it ends when the robot falls"] = None
    healthy_z_range: Annotated[Interval | None, "height of the torso [m]"] = None
    healthy_angle_range: Annotated[Interval | None, "angle of the torso [rad]"] = None
    healthy_state_range: Annotated[Interval | None, "all other positions and velocities"] = None

    def __post_init__(self) -> None:
        if self.robot not in RUNNERS:
            hint = did_you_mean(str(self.robot), RUNNERS)
            raise ConfigError(f"'robot' must be one of {list(RUNNERS)}, got {self.robot!r}.{hint}")
        defaults = RUNNERS[self.robot].defaults
        for row in fields(self)[1:]:
            value = getattr(self, row.name)
            if row.default is None and row.name not in defaults:
                if value is not None:
                    raise ConfigError(f"Robot '{self.robot}' has no key '{row.name}'.")
                continue
            value = defaults.get(row.name) if value is None else value
            vars(self)[row.name] = check_key(row.name, ANNOTATIONS[row.name], value)

    @classmethod
    def from_dict(cls, keys: Mapping[str, Any]) -> VelocityConfig:
        """Make a configuration from a mapping of keys.

        Raises:
            ConfigError: For an unknown robot or key, or a value that cannot be used.
        """
        for name in keys:
            if name not in ANNOTATIONS:
                hint = did_you_mean(str(name), ANNOTATIONS)
                raise ConfigError(f"A velocity environment has no key '{name}'.{hint}")
        return cls(**keys)

    def replace(self, **changes: Any) -> VelocityConfig:
        """Return a copy with some keys changed."""
        return VelocityConfig.from_dict(self.to_dict() | changes)

    def to_dict(self) -> dict[str, Any]:
        """Return the keys that the robot has, and their values."""
        return {key: value for key, value in vars(self).items() if value is not None}


ANNOTATIONS = get_type_hints(VelocityConfig, include_extras=True)

_COMMON = {row.name: row.default for row in fields(VelocityConfig) if row.default is not None}
VELOCITY_SUITE: dict[str, dict[str, Any]] = {
    f"Safe{row.gymnasium_id.removesuffix('-v5')}Velocity": {
        **_COMMON,
        "robot": name,
        **row.defaults,
    }
    for name, row in RUNNERS.items()
}


def velocity_name(name: str) -> str:
    """Return the name in `VELOCITY_SUITE` for a name or id, also one of Safety-Gymnasium.

    Examples:
        >>> velocity_name("SafetyHopperVelocity-v1"), velocity_name("SafeHopperVelocity-v0")
        ('SafeHopperVelocity', 'SafeHopperVelocity')
    """
    plain = name.removesuffix("-v0").removesuffix("-v1")
    return f"Safe{plain.removeprefix('Safety')}" if plain.startswith("Safety") else plain


def resolve_velocity(env: str | Mapping[str, Any] | VelocityConfig) -> VelocityConfig:
    """Return the configuration of a name, a mapping of keys, or a configuration.

    Args:
        env: A name or id as of `velocity_name`, a mapping with `robot` and any of its keys, or a
            `VelocityConfig`.

    Raises:
        ConfigError: For an unknown name (the nearest one is named), or an invalid configuration.
    """
    if isinstance(env, VelocityConfig):
        return env
    if not isinstance(env, str):
        return VelocityConfig.from_dict(env)
    name = velocity_name(env)
    if name not in VELOCITY_SUITE:
        raise ConfigError(
            f"Unknown environment '{env}'.{did_you_mean(name, VELOCITY_SUITE)} The velocity family "
            f"has {', '.join(VELOCITY_SUITE)}."
        )
    return VelocityConfig(**VELOCITY_SUITE[name])
