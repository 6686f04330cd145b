"""Frames of the robots, with a red sphere around one that is too fast."""

from __future__ import annotations

import mujoco
import numpy as np
from torch import Tensor

from safe_rl.envs.physics.batch import BatchPhysics
from safe_rl.envs.pictures import Camera, Marker, Pictures
from safe_rl.envs.velocity.locomotion import TORSO
from safe_rl.envs.velocity.runner_model import load_model
from safe_rl.envs.velocity.velocity_config import VelocityConfig

DISTANCE, ELEVATION = 4.0, -20.0  # of the free camera from the robot [m, degrees], as Gymnasium's
COST_RGBA, COST_RADIUS = (1.0, 0.0, 0.0, 0.35), 0.3


class RobotRenderer(Pictures):
    """Draws the robots of one environment as they are at the time."""

    def __init__(self, config: VelocityConfig, physics: BatchPhysics) -> None:
        super().__init__()
        self._config, self._physics = config, physics

    def frames(
        self, rows: list[int], has_cost: Tensor, camera: Camera, width: int, height: int
    ) -> np.ndarray:
        """Draw robots `rows`, with a sphere where `has_cost` [N]: uint8 [R, height, width, 3]."""
        frames = np.empty((len(rows), height, width, 3), dtype=np.uint8)
        for frame, row in zip(frames, rows, strict=True):
            self.data.qpos[:] = self._physics.qpos[row].numpy()
            self.place()
            sphere = Marker(
                mujoco.mjtGeom.mjGEOM_SPHERE,
                (COST_RADIUS,) * 3,
                self.data.xpos[TORSO],
                COST_RGBA,
            )
            frame[:] = self.frame(camera, width, height, [sphere] if has_cost[row] else [])
        return frames

    def free_camera(self) -> mujoco.MjvCamera:
        """Return a camera beside the robot that moves with it."""
        free = mujoco.MjvCamera()
        free.type, free.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, TORSO
        free.distance, free.elevation = DISTANCE, ELEVATION
        return free

    def _load(self) -> mujoco.MjModel:
        """The model without shadows, which take software OpenGL longer than all the rest."""
        model = load_model(self._config)
        model.light_castshadow[:] = 0
        return model
