"""What pictures show beyond the objects: lidar halos, the goal button, boundaries, costs.

Every function describes markers of one world as plain numbers; drawing them is the display's
business. Positions in metres, in the world.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import mujoco
import numpy as np

from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.rules.elements import BOX, CYLINDER, ELEMENTS, SPHERE

COST_RGBA, COST_RADIUS = (1.0, 0.0, 0.0, 0.5), 0.25
# of boundaries [m]: as good as endless
WALL_HALF_WIDTH, WALL_HALF_HEIGHT, WALL_HALF_LENGTH = 0.02, 0.1, 20.0
WALL_RGBA = (1.0, 0.4, 0.1, 0.3)
GOAL_BUTTON_RGBA = (0.4, 0.4, 0.4, 0.25)
# Share of its colour that a bin shows where it reads nothing, so that the ring can be seen.
DIMMEST = 0.1


class Marker(NamedTuple):
    """One shape: MuJoCo type, size as MJCF has it, centre [m], colour."""

    type: mujoco.mjtGeom
    size: tuple[float, float, float]
    pos: np.ndarray
    rgba: tuple[float, float, float, float]


def lidar_halos(
    config: SafetyGymConfig,
    readings: Mapping[str, np.ndarray],
    robot_pos: np.ndarray,
    robot_mat: np.ndarray,
) -> Iterator[Marker]:
    """Rings of spheres above the robot, one per lidar, as bright as the readings.

    Args:
        config: sizes and heights of the rings (`render_lidar_*`).
        readings: of every lidar by kind of object, [num_bins] in [0, 1].
        robot_pos: [3].
        robot_mat: columns are the robot's axes [3, 3].
    """
    radius, offset = config.render_lidar_radius, config.render_lidar_offset_init
    # A pseudo-lidar's bin is a sector and is drawn at its middle, a natural one's is a ray.
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


def goal_button(config: SafetyGymConfig, button_pos: np.ndarray) -> Marker:
    """A faint grey cylinder around the button that is the goal, centred at `button_pos` [3]."""
    radius = 2 * config.buttons_size
    return Marker(CYLINDER, (radius, radius, radius), button_pos, GOAL_BUTTON_RGBA)


def boundaries(config: SafetyGymConfig) -> Iterator[Marker]:
    """Low translucent walls where the robot must not go beyond."""
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


def cost_sphere(robot_pos: np.ndarray) -> Marker:
    """A red sphere around a robot at `robot_pos` [3] that incurs a cost."""
    return Marker(SPHERE, (COST_RADIUS,) * 3, robot_pos, COST_RGBA)
