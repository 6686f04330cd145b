"""The robots: one row each, with all differences between Gymnasium's environments.

MJCF files, frame skips, weights, ranges and noise are the defaults of Gymnasium's environments of
version 5; velocity thresholds are those of Safety-Gymnasium 1.0 (Ji et al. 2023, `v1`), half the
speed of a robot trained with PPO.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from safe_rl.envs.physics.dynamics import SCALES

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
