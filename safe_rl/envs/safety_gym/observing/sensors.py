"""The robot's own sensors as parts of the observation (paper section 4.1.1)."""

from __future__ import annotations

import mujoco
import torch
from torch import Tensor

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.records.scene import Scene
from safe_rl.envs.safety_gym.records.world import Block, Shapes, World


def _columns(model: mujoco.MjModel, sensors: list[int]) -> Tensor:
    """`sensordata` columns of sensors, in their order."""
    spans = [(model.sensor_adr[i], model.sensor_adr[i] + model.sensor_dim[i]) for i in sensors]
    return torch.tensor([column for span in spans for column in range(*span)], dtype=torch.int64)


def _joint_sensors(scene: Scene, kind: mujoco.mjtSensor, joint: mujoco.mjtJoint) -> list[int]:
    """Sensors of one type on one type of joint."""
    model = scene.model
    return [
        i
        for i in range(scene.robot_sensors)
        if model.sensor_type[i] == kind and model.jnt_type[model.sensor_objid[i]] == joint
    ]


def _named_sensors(config: SafetyGymConfig, scene: Scene) -> list[int]:
    known = {scene.model.sensor(i).name: i for i in range(scene.robot_sensors)}
    for name in config.sensors_obs:
        if name not in known:
            raise ConfigError(
                f"'sensors_obs': robot '{config.robot_base}' has no sensor '{name}'."
                f"{nearest(name, known)} It has {', '.join(known) or 'none'}: add the sensor "
                "to the robot's file, or list only those it has."
            )
    return [known[name] for name in config.sensors_obs]


def sensor_blocks(config: SafetyGymConfig, scene: Scene) -> list[Block]:
    """Robot sensors: raw ones, hinge angles as (sin, cos), ball joints as rotation matrices.

    Raises:
        ConfigError: for sensors the robot does not have, or sensors of slide joints.
    """
    if not config.observe_sensors:
        return []
    sensor, joint = mujoco.mjtSensor, mujoco.mjtJoint
    for kind in (sensor.mjSENS_JOINTPOS, sensor.mjSENS_JOINTVEL):
        for i in _joint_sensors(scene, kind, joint.mjJNT_SLIDE):
            raise ConfigError(
                f"'robot_base': {config.robot_base} has the sensor '{scene.model.sensor(i).name}' "
                "on a slide joint, and observations must not depend on where the world's origin "
                "is: remove the sensor, or set 'observe_sensors' to False."
            )
    raw, angles, quaternions = _named_sensors(config, scene), [], []
    if config.sensors_hinge_joints:
        raw += _joint_sensors(scene, sensor.mjSENS_JOINTVEL, joint.mjJNT_HINGE)
        angles += _joint_sensors(scene, sensor.mjSENS_JOINTPOS, joint.mjJNT_HINGE)
    if config.sensors_ball_joints:
        raw += _joint_sensors(scene, sensor.mjSENS_BALLANGVEL, joint.mjJNT_BALL)
        quaternions += _joint_sensors(scene, sensor.mjSENS_BALLQUAT, joint.mjJNT_BALL)
    # as in 2019, a sensor that is listed and of a joint is observed once, and as one of a joint
    raw = [i for i in dict.fromkeys(raw) if i not in (*angles, *quaternions)]
    if not config.sensors_angle_components:
        raw, angles, quaternions = raw + angles + quaternions, [], []
    readers = ((raw, _read_raw), (angles, _read_angles), (quaternions, _read_rotations))
    return [reader(scene.model, group) for group, reader in readers if group]


def _read_raw(model: mujoco.MjModel, sensors: list[int]) -> Block:
    shapes: Shapes = {model.sensor(i).name: (int(model.sensor_dim[i]),) for i in sensors}
    columns = _columns(model, sensors)
    return Block(shapes, lambda w: w.sensordata.index_select(1, columns))


def _read_angles(model: mujoco.MjModel, sensors: list[int]) -> Block:
    shapes: Shapes = {model.sensor(i).name: (2,) for i in sensors}
    columns = _columns(model, sensors)

    def read(world: World) -> Tensor:
        angle = world.sensordata.index_select(1, columns)
        return torch.stack([torch.sin(angle), torch.cos(angle)], -1).flatten(1)

    return Block(shapes, read)


def _read_rotations(model: mujoco.MjModel, sensors: list[int]) -> Block:
    shapes: Shapes = {model.sensor(i).name: (3, 3) for i in sensors}
    columns = _columns(model, sensors)

    def read(world: World) -> Tensor:
        quaternion = world.sensordata.index_select(1, columns).unflatten(1, (-1, 4))
        return rotation_matrix(quaternion).flatten(1)

    return Block(shapes, read)


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z) [..., 4] as rotation matrices [..., 3, 3]."""
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        *(w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))
