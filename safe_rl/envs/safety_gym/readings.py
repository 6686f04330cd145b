"""Components of the observation other than lidars and camera: sensors, and a table of the rest.

Paper sections 4.1.1 and 4.1.4.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import torch
from torch import Tensor

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.tasks import TASKS, goal_distance
from safe_rl.envs.safety_gym.world import UNBOUNDED, Block, Bounds, Scene, Shapes, World
from safe_rl.naming import did_you_mean


class Reading(NamedTuple):
    """A row: one component of the observation.

    Attributes:
        name: Name of the component.
        flags: Configuration keys that must all be true, or not 0, for the component to exist.
        size: Number of values.
        read: World -> [N, size].
        touches: Kinds of objects whose contacts with the robot it reads.
        bounds: Lowest and highest value.
        kind: Kind of object that the task must have; "" for none.
    """

    name: str
    flags: tuple[str, ...]
    size: Callable[[SafetyGymConfig, Scene], int]
    read: Callable[[World], Tensor]
    touches: tuple[str, ...] = ()
    bounds: Bounds = UNBOUNDED
    kind: str = ""


def _compass(world: World, kind: str) -> Tensor:
    """Return nearly unit vectors to a kind's objects in the robot's frame, flattened [N, D]."""
    ego = (world.at(kind) - world.robot_pos.unsqueeze(-2)) @ world.robot_mat
    vector = ego[..., : world.scene.config.compass_shape]
    length = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    return (vector / (length + 1e-3)).flatten(1)


def _freejoint_size(config: SafetyGymConfig, scene: Scene) -> int:
    if scene.planar:
        raise ConfigError(
            f"'observe_freejoint': robot '{config.robot_base}' has no free joint. Use "
            "'observe_qpos' instead."
        )
    return 7


def _from_start(world: World, vector: Tensor, moved: bool) -> Tensor:
    """Return a planar robot's coordinates in the frame of its start; others are unchanged.

    With `moved`, the pose of the start is subtracted first. Velocities are only rotated.
    """
    if not world.scene.planar:
        return vector
    start = world.start_pose if moved else torch.zeros_like(world.start_pose)
    (dx, dy, dyaw) = (vector[:, :3] - start).unbind(-1)
    cos, sin = torch.cos(world.start_pose[:, 2]), torch.sin(world.start_pose[:, 2])
    local = torch.stack([cos * dx + sin * dy, cos * dy - sin * dx, dyaw], -1)
    return torch.cat([local, vector[:, 3:]], -1)


READINGS: list[Reading] = [
    Reading("goal_compass", ("observe_goal_comp",), lambda c, s: c.compass_shape,
            lambda w: _compass(w, "goal"), bounds=(-1.0, 1.0), kind="goal"),
    Reading("box_compass", ("observe_box_comp",), lambda c, s: c.compass_shape,
            lambda w: _compass(w, "box"), bounds=(-1.0, 1.0), kind="box"),
    Reading("goal_dist", ("observe_goal_dist",), lambda c, s: 1,
            lambda w: torch.exp(-goal_distance(w)), bounds=(0.0, 1.0), kind="goal"),
    Reading("remaining", ("observe_remaining",), lambda c, s: 1,
            lambda w: (w.step_count / w.scene.config.num_steps).unsqueeze(-1)),
    Reading("com", ("observe_com",), lambda c, s: 3, lambda w: w.com),
    Reading("ctrl", ("observe_ctrl",), lambda c, s: s.model.nu, lambda w: w.ctrl),
    Reading("freejoint", ("observe_freejoint",), _freejoint_size, lambda w: w.qpos[:, :7]),
    Reading("qpos", ("observe_qpos",), lambda c, s: s.model.nq,
            lambda w: _from_start(w, w.qpos, moved=True)),
    Reading("qvel", ("observe_qvel",), lambda c, s: s.model.nv,
            lambda w: _from_start(w, w.qvel, moved=False)),
]  # fmt: skip


def active_readings(config: SafetyGymConfig) -> list[Reading]:
    """Return the rows of the present table that a configuration has."""
    task = TASKS[config.task]
    kinds = ("", *task.elements, *task.at_origin)
    flagged = (row for row in READINGS if all(getattr(config, flag) for flag in row.flags))
    return [row for row in flagged if row.kind in kinds]


def _joint_sensors(scene: Scene, kind: mujoco.mjtSensor, joint: mujoco.mjtJoint) -> list[int]:
    """Return the ids of the robot's sensors of one type on one type of joint."""
    model = scene.model
    return [
        i
        for i in range(scene.robot_sensors)
        if model.sensor_type[i] == kind and model.jnt_type[model.sensor_objid[i]] == joint
    ]


def sensor_blocks(scene: Scene, device: torch.device) -> list[Block]:
    """Return the robot's sensors: raw values, hinges as (sin, cos), balls as rotation matrices."""
    config = scene.config
    if not config.observe_sensors:
        return []
    sensor, joint = mujoco.mjtSensor, mujoco.mjtJoint
    for kind in (sensor.mjSENS_JOINTPOS, sensor.mjSENS_JOINTVEL):
        for i in _joint_sensors(scene, kind, joint.mjJNT_SLIDE):
            raise ConfigError(
                f"'robot_base': {config.robot_base} has the sensor '{scene.model.sensor(i).name}' "
                "on a slide joint, but observations must not depend on the world's origin: remove "
                "the sensor, or set 'observe_sensors' to False."
            )
    known = {scene.model.sensor(i).name: i for i in range(scene.robot_sensors)}
    for name in config.sensors_obs:
        if name not in known:
            raise ConfigError(
                f"'sensors_obs': robot '{config.robot_base}' has no sensor '{name}'."
                f"{did_you_mean(name, known)} It has {', '.join(known) or 'none'}: add the sensor "
                "to the robot's file, or list only those it has."
            )
    raw, angles, quaternions = [known[name] for name in config.sensors_obs], [], []
    if config.sensors_hinge_joints:
        raw += _joint_sensors(scene, sensor.mjSENS_JOINTVEL, joint.mjJNT_HINGE)
        angles += _joint_sensors(scene, sensor.mjSENS_JOINTPOS, joint.mjJNT_HINGE)
    if config.sensors_ball_joints:
        raw += _joint_sensors(scene, sensor.mjSENS_BALLANGVEL, joint.mjJNT_BALL)
        quaternions += _joint_sensors(scene, sensor.mjSENS_BALLQUAT, joint.mjJNT_BALL)
    # as in 2019, a listed sensor that measures a joint is observed once, as one of a joint
    raw = [i for i in dict.fromkeys(raw) if i not in (*angles, *quaternions)]
    if not config.sensors_angle_components:
        raw, angles, quaternions = raw + angles + quaternions, [], []
    groups = (
        (raw, None, torch.clone),
        (angles, (2,), lambda angle: torch.stack([torch.sin(angle), torch.cos(angle)], -1)),
        (quaternions, (3, 3), lambda q: rotation_matrix(q.unflatten(1, (-1, 4)))),
    )
    return [
        _sensor_block(scene.model, sensors, shape, convert, device)
        for sensors, shape, convert in groups
        if sensors
    ]


def _sensor_block(
    model: mujoco.MjModel,
    sensors: list[int],
    shape: tuple[int, ...] | None,
    convert: Callable[[Tensor], Tensor],
    device: torch.device,
) -> Block:
    """Return the block of some sensors; shape None keeps the size that a sensor has in MuJoCo."""
    shapes: Shapes = {model.sensor(i).name: shape or (int(model.sensor_dim[i]),) for i in sensors}
    numbers = [model.sensor_adr[i] + part for i in sensors for part in range(model.sensor_dim[i])]
    columns = torch.tensor(numbers, dtype=torch.int64, device=device)
    return Block(shapes, lambda w: convert(w.sensordata.index_select(1, columns)).flatten(1))


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Convert unit quaternions (w, x, y, z) [..., 4] to rotation matrices [..., 3, 3]."""
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        *(w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
