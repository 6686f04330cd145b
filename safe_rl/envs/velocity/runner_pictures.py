"""Frames of the robots, with a red sphere around one that is too fast."""

from __future__ import annotations

from typing import TypeAlias

import mujoco
import numpy as np
from torch import Tensor

from safe_rl.envs.errors import nearest
from safe_rl.envs.opengl import open_renderer
from safe_rl.envs.physics.batch import BatchPhysics
from safe_rl.envs.velocity.locomotion import TORSO
from safe_rl.envs.velocity.runner_model import load_model
from safe_rl.envs.velocity.velocity_config import VelocityConfig

FREE = "free"
DISTANCE, ELEVATION = 4.0, -20.0  # of the free camera from the robot [m, degrees], as Gymnasium's
COST_RGBA, COST_RADIUS = (1.0, 0.0, 0.0, 0.35), 0.3

Camera: TypeAlias = str | mujoco.MjvCamera


class RobotRenderer:
    """Draws the robots of one environment; nothing is opened before the first picture.

    Args:
        config: The environment.
        physics: The robots, drawn as they are at the time.
    """

    def __init__(self, config: VelocityConfig, physics: BatchPhysics) -> None:
        self._config, self._physics = config, physics
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        self._model: mujoco.MjModel | None = None

    def frames(
        self, rows: list[int], has_cost: Tensor, camera: Camera, width: int, height: int
    ) -> np.ndarray:
        """Draw some robots as they are now.

        Args:
            rows: Which, R of them.
            has_cost: Which of all incurred a cost in the last step, bool [N].
            camera: "free" (beside the robot and moving with it), a name in the model, or a
                custom camera.
            width: Of a frame [pixels].
            height: Of a frame [pixels].

        Returns:
            RGB, uint8 [R, height, width, 3].

        Raises:
            ValueError: For an unknown camera.
            OpenGLError: If OpenGL is missing or cannot be started.
        """
        model = self._load()
        chosen = _choose(model, camera)
        if (width, height) not in self._renderers:
            self._renderers[width, height] = open_renderer(model, width, height)
        renderer, data = self._renderers[width, height], mujoco.MjData(model)
        frames = np.empty((len(rows), height, width, 3), dtype=np.uint8)
        for frame, row in zip(frames, rows, strict=True):
            data.qpos[:] = self._physics.qpos[row].numpy()
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            renderer.update_scene(data, chosen)
            if has_cost[row]:
                _add_sphere(renderer.scene, data.xpos[TORSO])
            frame[:] = renderer.render()
        return frames

    def close(self) -> None:
        """Free what OpenGL holds; a later picture opens it again."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _load(self) -> mujoco.MjModel:
        """The model without shadows, which take software OpenGL longer than all the rest."""
        if self._model is None:
            self._model = load_model(self._config)
            self._model.light_castshadow[:] = 0
        return self._model


def _choose(model: mujoco.MjModel, camera: Camera) -> Camera:
    if camera == FREE:
        free = mujoco.MjvCamera()
        free.type, free.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, TORSO
        free.distance, free.elevation = DISTANCE, ELEVATION
        return free
    named = [name for i in range(model.ncam) if (name := model.camera(i).name)]
    if isinstance(camera, str) and camera not in named:
        known = [*named, FREE]
        raise ValueError(
            f"There is no camera '{camera}'.{nearest(camera, known)} Choose one of {known}, or "
            "give a mujoco.MjvCamera."
        )
    return camera


def _add_sphere(drawn: mujoco.MjvScene, position: np.ndarray) -> None:
    if drawn.ngeom < drawn.maxgeom:
        size, upright = np.full(3, COST_RADIUS), np.eye(3).reshape(-1)
        rgba = np.array(COST_RGBA, dtype=np.float32)
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        mujoco.mjv_initGeom(drawn.geoms[drawn.ngeom], sphere, size, position, upright, rgba)
        drawn.ngeom += 1
