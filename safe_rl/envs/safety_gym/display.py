"""Draw single worlds: frames, and images of the robot's camera."""

from __future__ import annotations

import functools
import math

import mujoco
import numpy as np
import torch
from torch import Tensor

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.pictures import Pictures
from safe_rl.envs.safety_gym.bodies import TRACK, VISION
from safe_rl.envs.safety_gym.building import build_scene
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.world import Block, Scene, World

TRACK_BEHIND, TRACK_ABOVE = 2.0, 2.0  # position of the tracking camera from the robot [m]


class Display(Pictures):
    """Draws worlds of one configuration; the model is compiled for the first picture.

    Args:
        config: The configuration of the environment.
    """

    def __init__(self, config: SafetyGymConfig) -> None:
        super().__init__()
        self._config = config
        self.options = mujoco.MjvOption()
        self.options.geomgroup[:] = 1  # all groups are visible; they only serve the lidar

    def _load(self) -> mujoco.MjModel:
        return self.scene.model

    @functools.cached_property
    def scene(self) -> Scene:
        """The decorated world that is drawn."""
        return build_scene(self._config, decorated=True)

    def pose(self, world: World, row: int) -> None:
        """Set all positions to those in one of the worlds, `row`."""
        data, physics = self.data, world.physics
        data.qpos[:] = _numbers(physics.qpos, row)
        # The mocap bodies of the plain world come first, then areas, which are no bodies there.
        mocap_pos = _numbers(physics.mocap_pos, row)
        num_areas = len(data.mocap_pos) - len(mocap_pos)
        areas = _numbers(world.positions, row)[len(self.scene.names) - num_areas :]
        data.mocap_pos[:] = np.concatenate([mocap_pos, areas])
        data.mocap_quat[: len(mocap_pos)] = _numbers(physics.mocap_quat, row)
        self.place()
        self._follow()

    def free_camera(self) -> mujoco.MjvCamera:
        """Return a movable camera in the south from which all placements are visible."""
        camera = mujoco.MjvCamera()
        camera.distance = 3 * max(abs(bound) for bound in self._config.placements_extents)
        return camera

    def _follow(self) -> None:
        """Place the tracking camera behind the robot, unless it is one of the robot's file."""
        model, data = self.scene.model, self.data
        camera = model.camera(TRACK).id
        if model.cam_bodyid[camera] != 0:
            return
        forward = self._heading()
        behind = -TRACK_BEHIND * forward + [0.0, 0.0, TRACK_ABOVE]
        data.cam_xpos[camera] = data.xpos[self.scene.robot_body] + behind
        right = np.cross(forward, [0.0, 0.0, 1.0])
        backward = behind / np.linalg.norm(behind)
        axes = np.stack([right, np.cross(backward, right), backward], axis=1)
        data.cam_xmat[camera] = axes.reshape(-1)

    def _heading(self) -> np.ndarray:
        """Return the robot's horizontal direction [3]: that of its camera, or its x axis."""
        model, data = self.scene.model, self.data
        camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, VISION)
        if camera >= 0:
            direction = -data.cam_xmat[camera].reshape(3, 3)[:, 2]
        else:
            direction = data.xmat[self.scene.robot_body].reshape(3, 3)[:, 0]
        angle = math.atan2(direction[1], direction[0])
        return np.array([math.cos(angle), math.sin(angle), 0.0])


def _numbers(values: torch.Tensor, row: int) -> np.ndarray:
    return values[row].cpu().numpy()


def vision_blocks(config: SafetyGymConfig, scene: Scene, device: torch.device) -> list[Block]:
    """Return the component `vision`: RGB in [0, 1], rows from top to bottom, [height, width, 3].

    Raises:
        ConfigError: If the robot has no camera of the name "vision".
    """
    if not config.observe_vision:
        return []
    cameras = [scene.model.camera(i).name for i in range(scene.model.ncam)]
    if VISION not in cameras:
        others = f" Its cameras are {cameras}: rename one of them." if cameras else ""
        raise ConfigError(
            f"'observe_vision': robot {config.robot_base!r} has no camera named '{VISION}'.{others}"
        )
    width, height = config.vision_size
    display = Display(config)

    def read(world: World) -> Tensor:
        pixels = torch.empty(len(world.step_count), height, width, 3, dtype=torch.uint8)
        # OpenGL draws one picture at a time.
        for row, picture in enumerate(pixels):
            display.pose(world, row)
            picture.copy_(torch.from_numpy(display.frame(VISION, width, height)))
        return pixels.flatten(1).to(world.robot_pos) / 255

    return [Block({"vision": (height, width, 3)}, read, (0.0, 1.0))]
