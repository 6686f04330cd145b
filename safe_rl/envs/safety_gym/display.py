"""Drawing single worlds: for frames, for MuJoCo's viewer and as what a robot's camera sees."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

import mujoco
import numpy as np
import torch
from torch import Tensor

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.opengl import PACKAGES, OpenGLError, has_screen, open_renderer
from safe_rl.envs.safety_gym.bodies import TRACK, VISION
from safe_rl.envs.safety_gym.building import build_scene
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.world import Block, Scene, World

FREE = "free"
TRACK_BEHIND, TRACK_ABOVE = 2.0, 2.0  # where the tracking camera is, from the robot [m]

Camera: TypeAlias = str | mujoco.MjvCamera


class Marker(NamedTuple):
    """One shape: MuJoCo type, size as MJCF has it, centre [m], colour."""

    type: mujoco.mjtGeom
    size: tuple[float, float, float]
    pos: np.ndarray
    rgba: tuple[float, float, float, float]


class Display:
    """Draws worlds of one configuration; nothing is built or opened before the first picture.

    Args:
        config: the environment.

    Examples:
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env = SafetyGymEnv("PointGoal1", seed=0)
        >>> _ = env.reset()
        >>> env.render(rows=0, camera="track", width=60, height=40).shape
        (40, 60, 3)
    """

    def __init__(self, config: SafetyGymConfig) -> None:
        self._config = config
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 1  # lidar's groups are no reason to hide anything

    @functools.cached_property
    def scene(self) -> Scene:
        """The world as it is drawn."""
        return build_scene(self._config, decorated=True)

    @functools.cached_property
    def data(self) -> mujoco.MjData:
        """Where everything is in the world that was posed last."""
        return mujoco.MjData(self.scene.model)

    @property
    def cameras(self) -> list[str]:
        """Names that `frame` takes."""
        model = self.scene.model
        named = [name for i in range(model.ncam) if (name := model.camera(i).name)]
        return [*named, FREE]

    def pose(self, world: World, row: int) -> None:
        """Put everything where it is in one of the worlds."""
        data, physics = self.data, world.physics
        data.qpos[:] = _numbers(physics.qpos, row)
        # The plain world's mocap bodies come first, then the areas that have none there.
        mocap_pos = _numbers(physics.mocap_pos, row)
        num_areas = len(data.mocap_pos) - len(mocap_pos)
        areas = _numbers(world.positions, row)[len(self.scene.names) - num_areas :]
        data.mocap_pos[:] = np.concatenate([mocap_pos, areas])
        data.mocap_quat[: len(mocap_pos)] = _numbers(physics.mocap_quat, row)
        mujoco.mj_kinematics(self.scene.model, data)
        mujoco.mj_comPos(self.scene.model, data)
        mujoco.mj_camlight(self.scene.model, data)
        self._follow()

    def frame(
        self,
        camera: Camera,
        width: int,
        height: int,
        markers: Iterable[Marker] = (),
        labels: bool = False,
    ) -> np.ndarray:
        """Draw the world that was posed last.

        Args:
            camera: a name of `cameras`, or a custom camera.
            width: of the picture [pixels].
            height: of the picture [pixels].
            markers: drawn besides the world.
            labels: write the names of objects at them.

        Returns:
            RGB, uint8 [height, width, 3].

        Raises:
            ValueError: for an unknown camera.
            OpenGLError: if OpenGL is missing or cannot be started.
        """
        chosen = self._camera(camera)
        renderer = self._renderers.get((width, height))
        if renderer is None:
            renderer = open_renderer(self.scene.model, width, height)
            self._renderers[width, height] = renderer
        renderer.update_scene(self.data, chosen, self._options)
        if labels:
            self._label(renderer.scene)
        add_markers(renderer.scene, markers)
        return renderer.render()

    def free_camera(self) -> mujoco.MjvCamera:
        """A camera in the south that has all placements in view and can be moved."""
        camera = mujoco.MjvCamera()
        camera.distance = 3 * max(abs(bound) for bound in self._config.placements_extents)
        return camera

    def close(self) -> None:
        """Free what OpenGL holds; a later picture opens it again."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _camera(self, camera: Camera) -> Camera:
        if camera == FREE:
            return self.free_camera()
        if isinstance(camera, str) and camera not in self.cameras:
            raise ValueError(
                f"There is no camera '{camera}'.{nearest(camera, self.cameras)} "
                f"Choose one of {self.cameras}, or give a mujoco.MjvCamera."
            )
        return camera

    def _follow(self) -> None:
        """Place the tracking camera behind the robot, looking down at it; not one of its own."""
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
        """Horizontal direction in which the robot looks [3]: its camera's, or its x axis."""
        model, data = self.scene.model, self.data
        camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, VISION)
        if camera >= 0:
            direction = -data.cam_xmat[camera].reshape(3, 3)[:, 2]
        else:
            direction = data.xmat[self.scene.robot_body].reshape(3, 3)[:, 0]
        angle = math.atan2(direction[1], direction[0])
        return np.array([math.cos(angle), math.sin(angle), 0.0])

    def _label(self, drawn: mujoco.MjvScene) -> None:
        """Write every object's name at the first of its shapes."""
        model, left = self.scene.model, set(self.scene.names)
        for geom in drawn.geoms[: drawn.ngeom]:
            if geom.objtype != mujoco.mjtObj.mjOBJ_GEOM:
                continue
            name = model.body(model.geom_bodyid[geom.objid]).name
            if name in left:
                geom.label = name
                left.remove(name)


def add_markers(drawn: mujoco.MjvScene, markers: Iterable[Marker]) -> None:
    """Append markers to what MuJoCo draws; those beyond its capacity are left out."""
    upright = np.eye(3).reshape(-1)
    for marker in markers:
        if drawn.ngeom == drawn.maxgeom:
            return
        geom = drawn.geoms[drawn.ngeom]
        rgba = np.array(marker.rgba, dtype=np.float32)
        mujoco.mjv_initGeom(geom, marker.type, np.array(marker.size), marker.pos, upright, rgba)
        drawn.ngeom += 1


def _numbers(values: torch.Tensor, row: int) -> np.ndarray:
    return values[row].cpu().numpy()


class Viewer:
    """A window onto a display; the mouse moves its camera.

    Args:
        display: what is shown, as it was posed last.

    Raises:
        OpenGLError: if there is no screen, or no OpenGL.
    """

    def __init__(self, display: Display) -> None:
        if not has_screen():
            raise OpenGLError(
                "MuJoCo's viewer needs a screen, and there is none here (neither DISPLAY nor "
                "WAYLAND_DISPLAY is set). Use render_mode='rgb_array', which needs none."
            )
        # Its import opens a connection to the screen.
        import mujoco.viewer

        try:
            self._window = mujoco.viewer.launch_passive(
                display.scene.model, display.data, show_left_ui=False, show_right_ui=False
            )
        except Exception as error:  # GLFW raises what it likes
            raise OpenGLError(
                f"MuJoCo's viewer cannot be opened ({error}). It needs OpenGL: on Debian or "
                f"Ubuntu 'apt-get install {PACKAGES['glfw']}'."
            ) from error
        camera = display.free_camera()
        with self._window.lock():
            self._window.cam.lookat[:] = camera.lookat
            self._window.cam.distance = camera.distance
            self._window.cam.azimuth, self._window.cam.elevation = camera.azimuth, camera.elevation
            self._window.opt.geomgroup[:] = 1

    @property
    def is_open(self) -> bool:
        """Whether nobody closed the window."""
        return self._window.is_running()

    def show(self, markers: Iterable[Marker]) -> None:
        """Bring the window up to date with the display, and draw markers in it."""
        if not self.is_open:
            return
        with self._window.lock():
            drawn = self._window.user_scn
            drawn.ngeom = 0
            add_markers(drawn, markers)
        self._window.sync()

    def close(self) -> None:
        """Close the window."""
        self._window.close()


def vision_blocks(config: SafetyGymConfig, scene: Scene, device: torch.device) -> list[Block]:
    """The component `vision`: RGB in [0, 1], lines from top to bottom, [height, width, 3].

    Raises:
        ConfigError: if the robot has no camera.
    """
    if not config.observe_vision:
        return []
    cameras = [scene.model.camera(i).name for i in range(scene.model.ncam)]
    if VISION not in cameras:
        others = f" Its cameras are {cameras}: give one that name." if cameras else ""
        raise ConfigError(
            f"'observe_vision': robot {config.robot_base!r} has no camera named '{VISION}'.{others}"
        )
    width, height = config.vision_size
    display = Display(config)

    def read(world: World) -> Tensor:
        pixels = torch.empty(len(world.step_count), height, width, 3, dtype=torch.uint8)
        # OpenGL draws one picture after the other.
        for row, picture in enumerate(pixels):
            display.pose(world, row)
            picture.copy_(torch.from_numpy(display.frame(VISION, width, height)))
        return pixels.flatten(1).to(world.robot_pos) / 255

    return [Block({"vision": (height, width, 3)}, read, (0.0, 1.0))]
