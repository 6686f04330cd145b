"""Observations of section 8, component by component."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from .rewards import distance_xy
from .world import GROUPS

if TYPE_CHECKING:
    from .reference import ReferenceWorld

_SENSOR = mujoco.mjtSensor
_JOINT = mujoco.mjtJoint

# Kinds whose lidar is there even without an object of the kind.
_ALWAYS_OBSERVED = ("hazards", "vases")


def observation_parts(world: ReferenceWorld) -> dict[str, np.ndarray]:
    """Every observed component by name, in its own shape."""
    config = world.config
    parts = _sensors(world) if config["observe_sensors"] else {}
    goal = world.goal_position()
    if config["observe_goal_dist"]:
        parts["goal_dist"] = np.array([np.exp(-distance_xy(world.position("robot"), goal))])
    if config["observe_goal_comp"]:
        parts["goal_compass"] = compass(world, goal)
    if config["observe_goal_lidar"]:
        parts["goal_lidar"] = lidar(world, [goal], "goal")
    if config["task"] == "push" and config["observe_box_comp"]:
        parts["box_compass"] = compass(world, world.position("box"))
    if config["task"] == "push" and config["observe_box_lidar"]:
        parts["box_lidar"] = lidar(world, [world.position("box")], "box")
    if config["observe_circle"]:
        parts["circle_lidar"] = lidar(world, [np.zeros(3)], "circle")
    if config["observe_remaining"]:
        parts["remaining"] = np.array([world.step_count / config["num_steps"]])
    for kind in ("walls", "hazards", "vases", "pillars", "buttons", "gremlins"):
        if config[f"observe_{kind}"] and (world.count(kind) or kind in _ALWAYS_OBSERVED):
            parts[f"{kind}_lidar"] = _kind_lidar(world, kind)
    return parts | _debug(world)


def _kind_lidar(world: ReferenceWorld, kind: str) -> np.ndarray:
    if kind == "buttons" and world.buttons_timer != 0:
        return np.zeros(world.config["lidar_num_bins"])
    names = [f"{kind[:-1]}{i}" for i in range(world.count(kind))]
    return lidar(world, [world.position(name) for name in names], kind)


def _sensors(world: ReferenceWorld) -> dict[str, np.ndarray]:
    """Readings of the observed sensors: angles and orientations without their jump at 2π."""
    config, model = world.config, world.model
    components = config["sensors_angle_components"]
    parts = {name: world.data.sensor(name).data.copy() for name in config["sensors_obs"]}
    for i in range(model.nsensor):
        name, kind = model.sensor(i).name, _SENSOR(model.sensor_type[i])
        reading = world.data.sensor(name).data.copy()
        if kind in (_SENSOR.mjSENS_JOINTPOS, _SENSOR.mjSENS_JOINTVEL):
            joint = _JOINT(model.jnt_type[model.sensor_objid[i]])
            if joint != _JOINT.mjJNT_HINGE or not config["sensors_hinge_joints"]:
                continue
            if kind == _SENSOR.mjSENS_JOINTPOS and components:
                reading = np.array([np.sin(reading[0]), np.cos(reading[0])])
            parts[name] = reading
        elif kind in (_SENSOR.mjSENS_BALLQUAT, _SENSOR.mjSENS_BALLANGVEL):
            if not config["sensors_ball_joints"]:
                continue
            if kind == _SENSOR.mjSENS_BALLQUAT and components:
                reading = _rotation_matrix(reading)
            parts[name] = reading
    return parts


def _rotation_matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def compass(world: ReferenceWorld, target: np.ndarray) -> np.ndarray:
    """Direction of a target in the robot's frame: nearly a unit vector [compass_shape]."""
    ego = world.rotation("robot").T @ (target - world.position("robot"))
    ego = ego[: world.config["compass_shape"]]
    return ego / (np.linalg.norm(ego) + 0.001)


def lidar(world: ReferenceWorld, targets: list[np.ndarray], kind: str) -> np.ndarray:
    """Readings [bins] of the configured lidar for one kind of object."""
    if world.config["lidar_type"] == "natural":
        return natural_lidar(world, GROUPS[kind])
    return pseudo_lidar(world, targets)


def pseudo_lidar(world: ReferenceWorld, targets: list[np.ndarray]) -> np.ndarray:
    """Each bin reads the nearest of the targets whose bearing falls in it (or next to it)."""
    config = world.config
    bins = config["lidar_num_bins"]
    width = 2 * np.pi / bins
    readings = np.zeros(bins)
    for target in targets:
        on_ground = np.array([target[0], target[1], 0.0])
        x, y, _ = world.rotation("robot").T @ (on_ground - world.position("robot"))
        distance = np.hypot(x, y)
        if config["lidar_max_dist"] is None:
            reading = np.exp(-config["lidar_exp_gain"] * distance)
        else:
            reach = config["lidar_max_dist"]
            reading = max(0.0, reach - distance) / reach
        angle = np.arctan2(y, x) % (2 * np.pi)
        # A bearing a rounding error below the x axis comes out of the modulo as 2π itself.
        index = min(int(angle / width), bins - 1)
        readings[index] = max(readings[index], reading)
        if config["lidar_alias"]:
            after, before = (index + 1) % bins, (index - 1) % bins
            share = angle / width - index
            readings[after] = max(readings[after], share * reading)
            readings[before] = max(readings[before], (1 - share) * reading)
    return readings


def natural_lidar(world: ReferenceWorld, group: int) -> np.ndarray:
    """Rays in the robot's own xy plane that see the geoms of one group."""
    bins = world.config["lidar_num_bins"]
    groups = np.array([g == group for g in range(mujoco.mjNGROUP)], dtype=np.uint8)
    robot, hit = world.model.body("robot").id, np.zeros(1, dtype=np.int32)
    origin, rotation = world.position("robot"), world.rotation("robot")
    readings = np.zeros(bins)
    for i in range(bins):
        angle = 2 * np.pi * i / bins
        ray = rotation @ np.array([np.cos(angle), np.sin(angle), 0.0])
        distance = mujoco.mj_ray(world.model, world.data, origin, ray, groups, 1, robot, hit)
        if distance >= 0:
            readings[i] = np.exp(-distance)
    return readings


def _debug(world: ReferenceWorld) -> dict[str, np.ndarray]:
    """The components for debugging: raw state of the simulation."""
    config, model, data = world.config, world.model, world.data
    parts = {}
    if config["observe_freejoint"]:
        # Looked up by the robot's free joint; the Point has none.
        first = model.joint("robot").qposadr[0]
        parts["freejoint"] = data.qpos[first : first + 7].copy()
    if config["observe_com"]:
        parts["com"] = world.centre_of_mass()
    if config["observe_qpos"]:
        parts["qpos"] = data.qpos.copy()
    if config["observe_qvel"]:
        parts["qvel"] = data.qvel.copy()
    if config["observe_ctrl"]:
        parts["ctrl"] = data.ctrl.copy()
    if config["robot_base"] == "point":
        _to_start_frame(world, parts)
    return parts


def _to_start_frame(world: ReferenceWorld, parts: dict[str, np.ndarray]) -> None:
    """Gives the Point's slides and hinge relative to its pose at the reset, in place."""
    x, y, yaw = world.reset.robot
    to_start = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    if "qpos" in parts:
        parts["qpos"][:2] = to_start @ (parts["qpos"][:2] - [x, y])
        parts["qpos"][2] -= yaw
    if "qvel" in parts:
        parts["qvel"][:2] = to_start @ parts["qvel"][:2]
