"""Pictures of worlds: images of the robot's camera, and frames of an environment.

Frames also show lidar halos, goal button, boundaries and costs. Positions are in metres, in the
world's frame.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np
import torch
from torch import Tensor

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.pictures import Camera, Marker, Pictures, resize
from safe_rl.envs.safety_gym.building import VISION, build_scene
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.elements import BOX, CYLINDER, ELEMENTS, SPHERE
from safe_rl.envs.safety_gym.lidar import lidar_blocks
from safe_rl.envs.safety_gym.world import NO_BUTTON, Block, Scene, World

TRACK_DISTANCE = math.hypot(2.0, 2.0)  # the tracking camera is 2 m behind the robot and 2 m above


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

    @property
    def model(self) -> mujoco.MjModel:
        """The model of the decorated world."""
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

    def free_cameras(self) -> dict[str, mujoco.MjvCamera]:
        """Return one behind the robot, and one in the south from which all placements are visible.

        The robot looks along its camera, or along its x axis if it has none.
        """
        free, track = mujoco.MjvCamera(), mujoco.MjvCamera()
        free.distance = 3 * max(abs(bound) for bound in self._config.placements_extents)
        data, robot = self.data, self.scene.robot_body
        camera = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_CAMERA, VISION)
        ahead = data.xmat[robot].reshape(3, 3)[:, 0]
        if camera >= 0:
            ahead = -data.cam_xmat[camera].reshape(3, 3)[:, 2]
        track.lookat, track.distance = data.xpos[robot], TRACK_DISTANCE
        track.azimuth = math.degrees(math.atan2(ahead[1], ahead[0]))
        return {"track": track, "free": free}


def _numbers(values: torch.Tensor, row: int) -> np.ndarray:
    return values[row].cpu().numpy()


def vision_block(scene: Scene, display: Display) -> Block:
    """Return the component `vision`: RGB in [0, 1], rows from top to bottom, [height, width, 3].

    `display` draws it.

    Raises:
        ConfigError: If the robot has no camera of the name "vision".
    """
    config = scene.config
    cameras = [scene.model.camera(i).name for i in range(scene.model.ncam)]
    if VISION not in cameras:
        others = f" Its cameras are {cameras}: rename one of them." if cameras else ""
        raise ConfigError(
            f"'observe_vision': robot {config.robot_base!r} has no camera named '{VISION}'.{others}"
        )
    width, height = config.vision_size

    def read(world: World) -> Tensor:
        pixels = torch.empty(len(world.step_count), height, width, 3, dtype=torch.uint8)
        # OpenGL draws one picture at a time.
        for row, picture in enumerate(pixels):
            display.pose(world, row)
            picture.copy_(torch.from_numpy(display.frame(VISION, width, height)))
        return pixels.flatten(1).to(world.robot_pos) / 255

    return Block({"vision": (height, width, 3)}, read, (0.0, 1.0))


COST_RGBA, COST_RADIUS = (1.0, 0.0, 0.0, 0.5), 0.25
# Sizes of boundaries [m]; a wall along one boundary only is longer than any arena.
WALL_HALF_WIDTH, WALL_HALF_HEIGHT, WALL_HALF_LENGTH = 0.02, 0.1, 20.0
WALL_RGBA = (1.0, 0.4, 0.1, 0.3)
GOAL_BUTTON_RGBA = (0.4, 0.4, 0.4, 0.25)
# Brightness of a bin whose reading is 0, so that the whole ring is visible.
DIMMEST = 0.1


def lidar_halos(
    config: SafetyGymConfig,
    readings: Mapping[str, np.ndarray],
    robot_pos: np.ndarray,
    robot_mat: np.ndarray,
) -> Iterator[Marker]:
    """Yield a ring of spheres above the robot for each lidar, as bright as its readings [0, 1]."""
    radius, offset = config.render_lidar_radius, config.render_lidar_offset_init
    # A bin of the pseudo-lidar is a sector, drawn at its middle; that of the natural one is a ray.
    middle = 0.5 if config.lidar_type == "pseudo" else 0.0
    for element in ELEMENTS:
        if element.kind not in readings:
            continue
        bins = readings[element.kind]
        for index, reading in enumerate(bins):
            bearing = 2 * math.pi * (index + middle) / len(bins)
            local = (radius * math.cos(bearing), radius * math.sin(bearing), offset)
            brightness = min(1.0, float(reading) + DIMMEST)
            red, green, blue = (brightness * part for part in element.rgb)
            yield Marker(
                type=SPHERE,
                size=(config.render_lidar_size,) * 3,
                pos=robot_pos + robot_mat @ local,
                rgba=(red, green, blue, brightness),
            )
        offset += config.render_lidar_offset_delta


def boundaries(config: SafetyGymConfig) -> Iterator[Marker]:
    """Yield low translucent walls at the boundaries."""
    if not config.constrain_boundary:
        return
    halves = [config.boundary_x, config.boundary_y]
    for axis, half in enumerate(halves):
        if half is None:
            continue
        size = [0.0, 0.0, WALL_HALF_HEIGHT]
        size[axis], size[1 - axis] = WALL_HALF_WIDTH, halves[1 - axis] or WALL_HALF_LENGTH
        for side in (-half, half):
            pos = np.array([0.0, 0.0, WALL_HALF_HEIGHT])
            pos[axis] = side
            yield Marker(BOX, (size[0], size[1], size[2]), pos, WALL_RGBA)


# Largest share of a frame's width and height for the inset of the robot's camera.
INSET_SHARE = 1 / 3


class WorldRenderer(Display):
    """Draws the worlds of one environment with lidar halos, goal button, costs and labels."""

    def __init__(self, world: World) -> None:
        super().__init__(world.scene.config)
        self._world = world
        lidars = lidar_blocks(world.scene, world.physics.device)
        self._lidars = lidars if self._config.render_lidar_markers else []

    def frames(
        self, rows: list[int], has_cost: Tensor, camera: Camera, width: int, height: int
    ) -> np.ndarray:
        """Draw worlds `rows`, with a sphere where `has_cost` [N]: uint8 [R, height, width, 3]."""
        readings = self._readings()
        labels = self._world.scene.names if self._config.render_labels else ()
        frames = np.empty((len(rows), height, width, 3), dtype=np.uint8)
        for frame, row in zip(frames, rows, strict=True):
            self.pose(self._world, row)
            markers = self._markers(row, readings, bool(has_cost[row]))
            frame[:] = self.frame(camera, width, height, markers, labels)
            self._add_inset(frame)
        return frames

    def _readings(self) -> dict[str, Tensor]:
        readings: dict[str, Tensor] = {}
        for block in self._lidars:
            kinds = [name.removesuffix("_lidar") for name in block.shapes]
            values = block.read(self._world).unflatten(1, (len(kinds), -1))
            readings |= zip(kinds, values.unbind(1), strict=True)
        return readings

    def _markers(self, row: int, readings: dict[str, Tensor], has_cost: bool) -> Iterator[Marker]:
        world = self._world
        robot_pos, robot_mat = _numbers(world.robot_pos, row), _numbers(world.robot_mat, row)
        seen = {kind: _numbers(values, row) for kind, values in readings.items()}
        yield from lidar_halos(self._config, seen, robot_pos, robot_mat)
        button = int(world.goal_button[row])
        if button != NO_BUTTON:
            button_pos = _numbers(world.at("buttons"), row)[button]
            size = (2 * self._config.buttons_size,) * 3
            yield Marker(CYLINDER, size, button_pos, GOAL_BUTTON_RGBA)
        yield from boundaries(self._config)
        if has_cost:
            yield Marker(SPHERE, (COST_RADIUS,) * 3, robot_pos, COST_RGBA)

    def _add_inset(self, frame: np.ndarray) -> None:
        """Draw the image of the robot's camera in a corner, if it is observed and rendered."""
        config = self._config
        if not (config.observe_vision and config.vision_render):
            return
        seen = self.frame(VISION, *config.vision_size)
        width, height = config.vision_render_size
        largest_height, largest_width = (INSET_SHARE * side for side in frame.shape[:2])
        scale = min(1.0, largest_width / width, largest_height / height)
        inset = resize(seen, max(1, round(scale * width)), max(1, round(scale * height)))
        frame[: inset.shape[0], : inset.shape[1]] = inset
