"""What a robot observes: a table of sources, from which sizes, order and values all come.

A source yields a block: named components that are computed together. The observation is all
components in alphabetical order of their names (paper section 4.1.4).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from safe_rl.envs.config import ConfigError, SafetyGymConfig
from safe_rl.envs.lidar import compass, to_ego
from safe_rl.envs.lidar_blocks import lidar_blocks
from safe_rl.envs.rendering.vision import vision_blocks
from safe_rl.envs.scene import Scene
from safe_rl.envs.sensors import sensor_blocks
from safe_rl.envs.tasks import TASKS, distance
from safe_rl.envs.world import Block, Shapes, World


class Reading(NamedTuple):
    """A row of the table of plain observations.

    Attributes:
        name: of the component.
        present: whether a configuration has it.
        size: number of values.
        read: world -> [N, size].
    """

    name: str
    present: Callable[[SafetyGymConfig], bool]
    size: Callable[[SafetyGymConfig, Scene], int]
    read: Callable[[World], Tensor]


def _ego(world: World, kind: str) -> Tensor:
    return to_ego(world.at(kind), world.robot_pos, world.robot_mat)


def _compass_to(kind: str) -> Callable[[World], Tensor]:
    return lambda w: compass(_ego(w, kind), w.scene.config.compass_shape).flatten(1)


def _goal_closeness(world: World) -> Tensor:
    to_goal = distance(world.robot_pos[:, None, :2], world.at("goal")[..., :2])
    return torch.exp(-to_goal)


def _remaining(world: World) -> Tensor:
    return (world.step_count / world.scene.config.num_steps).unsqueeze(-1)


def _from_start(world: World, vector: Tensor, moved: bool) -> Tensor:
    """A planar robot's coordinates as seen from where it started: observations know no origin."""
    if not world.scene.planar:
        return vector
    start = world.start_pose if moved else torch.zeros_like(world.start_pose)
    (dx, dy, dyaw) = (vector[:, :3] - start).unbind(-1)
    cos, sin = torch.cos(world.start_pose[:, 2]), torch.sin(world.start_pose[:, 2])
    local = torch.stack([cos * dx + sin * dy, cos * dy - sin * dx, dyaw], -1)
    return torch.cat([local, vector[:, 3:]], -1)


def _has(config: SafetyGymConfig, element: str) -> bool:
    return element in TASKS[config.task].elements


READINGS: tuple[Reading, ...] = (
    Reading(
        "goal_compass",
        lambda c: c.observe_goal_comp and _has(c, "goal"),
        lambda c, s: c.compass_shape,
        _compass_to("goal"),
    ),
    Reading(
        "box_compass",
        lambda c: c.observe_box_comp and _has(c, "box"),
        lambda c, s: c.compass_shape,
        _compass_to("box"),
    ),
    Reading(
        "goal_dist",
        lambda c: c.observe_goal_dist and _has(c, "goal"),
        lambda c, s: 1,
        _goal_closeness,
    ),
    Reading("remaining", lambda c: c.observe_remaining, lambda c, s: 1, _remaining),
    Reading("com", lambda c: c.observe_com, lambda c, s: 3, lambda w: w.com),
    Reading("ctrl", lambda c: c.observe_ctrl, lambda c, s: s.model.nu, lambda w: w.ctrl),
    Reading(
        "freejoint",
        lambda c: c.observe_freejoint,
        lambda c, s: 7,
        lambda w: w.qpos[:, :7],
    ),
    Reading(
        "qpos",
        lambda c: c.observe_qpos,
        lambda c, s: s.model.nq,
        lambda w: _from_start(w, w.qpos, moved=True),
    ),
    Reading(
        "qvel",
        lambda c: c.observe_qvel,
        lambda c, s: s.model.nv,
        lambda w: _from_start(w, w.qvel, moved=False),
    ),
)


def _plain(config: SafetyGymConfig, scene: Scene) -> list[Block]:
    return [
        Block({row.name: (row.size(config, scene),)}, row.read)
        for row in READINGS
        if row.present(config)
    ]


SOURCES: tuple[Callable[[SafetyGymConfig, Scene], list[Block]], ...] = (
    sensor_blocks,
    lidar_blocks,
    _plain,
    vision_blocks,
)


class Observer(NamedTuple):
    """How to observe the worlds of one scene.

    Attributes:
        shapes: shape of every component, in the order of the flat observation.
        columns: columns of every component in the flat observation.
        read: world -> flat observation [N, n], float64.
    """

    shapes: Shapes
    columns: dict[str, slice]
    read: Callable[[World], Tensor]

    @property
    def size(self) -> int:
        """Number of columns of the flat observation."""
        return sum(math.prod(shape) for shape in self.shapes.values())

    def split(self, flat: Tensor) -> dict[str, Tensor]:
        """Views of a flat observation [N, n] by component, each [N, *shape]."""
        return {
            name: flat[:, self.columns[name]].unflatten(1, shape)
            for name, shape in self.shapes.items()
        }


def make_observer(scene: Scene) -> Observer:
    """Resolve what a configuration observes.

    Raises:
        ConfigError: for sensors the robot does not have, if two components have one name, or if
            nothing is observed.
    """
    blocks = [block for source in SOURCES for block in source(scene.config, scene)]
    names = [name for block in blocks for name in block.shapes]
    if not names:
        raise ConfigError("Nothing is observed: set at least one 'observe_*' key.")
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                f"Two observations are called '{name}': rename the robot's sensor, or the "
                "observation that was registered."
            )
    unordered: Shapes = {name: shape for block in blocks for name, shape in block.shapes.items()}
    starts, start = {}, 0
    for name, shape in unordered.items():
        starts[name], start = start, start + math.prod(shape)
    shapes = {name: unordered[name] for name in sorted(unordered)}
    columns: dict[str, slice] = {}
    first, order = 0, list[int]()
    for name, shape in shapes.items():
        size = math.prod(shape)
        columns[name], first = slice(first, first + size), first + size
        order += range(starts[name], starts[name] + size)
    permutation = torch.tensor(order)

    def read(world: World) -> Tensor:
        values = torch.cat([block.read(world) for block in blocks], -1)
        return values.index_select(1, permutation)

    return Observer(shapes, columns, read)
