"""Frames of an environment's worlds, with everything that helps a person to follow them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from torch import Tensor

from safe_rl.envs.safety_gym.records.world import NO_BUTTON, Block, World
from safe_rl.envs.safety_gym.rendering.display import Camera, Display
from safe_rl.envs.safety_gym.rendering.markers import (
    Marker,
    boundaries,
    cost_sphere,
    goal_button,
    lidar_halos,
)
from safe_rl.envs.safety_gym.rendering.viewer import Viewer
from safe_rl.envs.safety_gym.world.scenery import VISION

# Largest share of a frame's width and height that the inset of the robot's camera takes.
INSET_SHARE = 1 / 3


class WorldRenderer:
    """Draws the worlds of one environment with lidar halos, goal button, costs and labels.

    Args:
        world: what is drawn, as it is at the time of drawing.
        lidars: the observation's lidars, of which halos are drawn.
    """

    def __init__(self, world: World, lidars: list[Block]) -> None:
        self._world = world
        self._config = config = world.scene.config
        self._display = Display(config)
        self._lidars = lidars if config.render_lidar_markers else []
        self._viewer: Viewer | None = None

    def frames(
        self, rows: list[int], has_cost: Tensor, camera: Camera, width: int, height: int
    ) -> np.ndarray:
        """Draw some of the worlds.

        Args:
            rows: which, R of them.
            has_cost: which of all worlds incurred a cost in the last step, bool [N].
            camera: a name, or a camera of one's own.
            width: of a frame [pixels].
            height: of a frame [pixels].

        Returns:
            RGB, uint8 [R, height, width, 3].
        """
        readings = self._readings()
        labels = self._config.render_labels
        frames = np.empty((len(rows), height, width, 3), dtype=np.uint8)
        for frame, row in zip(frames, rows, strict=True):
            self._display.pose(self._world, row)
            markers = self._markers(row, readings, bool(has_cost[row]))
            frame[:] = self._display.frame(camera, width, height, markers, labels)
            self._add_inset(frame)
        return frames

    def show(self, row: int, has_cost: Tensor) -> None:
        """Show one of the worlds in MuJoCo's viewer, which is opened by the first call.

        Raises:
            OpenGLError: if there is no screen.
        """
        self._display.pose(self._world, row)
        if self._viewer is None:
            self._viewer = Viewer(self._display)
        self._viewer.show(self._markers(row, self._readings(), bool(has_cost[row])))

    def close(self) -> None:
        """Close the viewer and free what OpenGL holds."""
        self._display.close()
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def _readings(self) -> dict[str, Tensor]:
        """Present lidar readings of all worlds by kind, [N, num_bins]."""
        readings: dict[str, Tensor] = {}
        for block in self._lidars:
            kinds = [name.removesuffix("_lidar") for name in block.shapes]
            values = block.read(self._world).unflatten(1, (len(kinds), -1))
            readings |= zip(kinds, values.unbind(1), strict=True)
        return readings

    def _markers(self, row: int, readings: dict[str, Tensor], has_cost: bool) -> Iterator[Marker]:
        world = self._world
        robot_pos = world.robot_pos[row].cpu().numpy()
        robot_mat = world.robot_mat[row].cpu().numpy()
        seen = {kind: values[row].cpu().numpy() for kind, values in readings.items()}
        yield from lidar_halos(self._config, seen, robot_pos, robot_mat)
        button = int(world.goal_button[row])
        if button != NO_BUTTON:
            yield goal_button(self._config, world.at("buttons")[row, button].cpu().numpy())
        yield from boundaries(self._config)
        if has_cost:
            yield cost_sphere(robot_pos)

    def _add_inset(self, frame: np.ndarray) -> None:
        """Show in a corner what the robot's camera sees, where that is observed."""
        config = self._config
        if not (config.observe_vision and config.vision_render):
            return
        seen = self._display.frame(VISION, *config.vision_size)
        width, height = config.vision_render_size
        largest_height, largest_width = (INSET_SHARE * side for side in frame.shape[:2])
        scale = min(1.0, largest_width / width, largest_height / height)
        inset = _resize(seen, max(1, round(scale * width)), max(1, round(scale * height)))
        frame[: inset.shape[0], : inset.shape[1]] = inset


def _resize(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize by taking the nearest pixels."""
    lines = np.arange(height) * picture.shape[0] // height
    columns = np.arange(width) * picture.shape[1] // width
    return picture[lines[:, None], columns]
