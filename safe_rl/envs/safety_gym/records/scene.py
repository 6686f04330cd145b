"""A compiled world, and the integer maps into its arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco

from safe_rl.envs.safety_gym.records.config import SafetyGymConfig


@dataclass(frozen=True)
class Scene:
    """A compiled world and where things are in it.

    Attributes:
        config: the configuration it was built from.
        model: the compiled model.
        names: name of every object, by slot; slots are the M of `[N, M, …]` tensors.
        slots: slots of each kind that has objects.
        kinds: names of all kinds, also of those without.
        heights: z of every object's centre [m], by slot.
        num_free: slots below this are free bodies, 7 `qpos` and 6 `qvel` each after the robot's.
        num_mocap_slots: that many slots from `num_free` on are mocap bodies (after the targets').
        guided: slots of the bodies that are welded to a target which runs in a circle.
        num_targets: mocap bodies that those are welded to; the first ones.
        travel: radius of each target's circle [m], by guided slot.
        robot_body: body id of the robot's root.
        robot_sensors: number of the robot file's own sensors, which come first.
        robot_nq, robot_nv: the robot's share of `qpos` and `qvel`, which comes first.
        planar: whether the root is (x, y, yaw) instead of a free joint.
        oriented_body: body id of the part that `reward_orientation` looks at.
        free_bodies: body ids of the free slots.
        contacts: `sensordata` columns of each kind's contact counts with the robot.
    """

    config: SafetyGymConfig
    model: mujoco.MjModel
    names: tuple[str, ...]
    slots: Mapping[str, slice]
    kinds: tuple[str, ...]
    heights: tuple[float, ...]
    num_free: int
    num_mocap_slots: int
    guided: slice
    num_targets: int
    travel: tuple[float, ...]
    robot_body: int
    robot_sensors: int
    robot_nq: int
    robot_nv: int
    planar: bool
    oriented_body: int
    free_bodies: slice
    contacts: Mapping[str, slice]
