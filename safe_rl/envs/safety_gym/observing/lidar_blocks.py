"""The two kinds of lidar as parts of the observation (paper section 4.1.4).

Pseudo-lidar computes bearings and distances of object centres; natural lidar casts rays into the
physics and sees surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial

import torch
from torch import Tensor

from safe_rl.envs.safety_gym.geometry import floor_to_ego
from safe_rl.envs.safety_gym.observing.lidar import lidar_cells, pseudo_lidar
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.records.scene import Scene
from safe_rl.envs.safety_gym.records.world import Block, World
from safe_rl.envs.safety_gym.rules.elements import ELEMENTS, NUM_RAY_GROUPS, Element
from safe_rl.envs.safety_gym.rules.tasks import TASKS


def lidar_blocks(config: SafetyGymConfig, scene: Scene) -> list[Block]:
    """All lidars of a configuration, as one block."""
    elements = [element for element in ELEMENTS if element.observed(config)]
    if not elements:
        return []
    read = _LIDARS[config.lidar_type](config, scene, elements)
    bins, kinds = config.lidar_num_bins, [element.kind for element in elements]
    if "buttons" in kinds:
        first = kinds.index("buttons") * bins
        read = _while_awake(read, slice(first, first + bins))
    return [Block({f"{kind}_lidar": (bins,) for kind in kinds}, read, (0.0, 1.0))]


def _while_awake(read: Callable[[World], Tensor], columns: slice) -> Callable[[World], Tensor]:
    """Buttons are not seen while they wait for the next goal."""

    def read_awake(world: World) -> Tensor:
        readings = read(world)
        readings[:, columns] *= (world.buttons_timer == 0).unsqueeze(-1)
        return readings

    return read_awake


def _pseudo(
    config: SafetyGymConfig, scene: Scene, elements: list[Element]
) -> Callable[[World], Tensor]:
    """Every object that any lidar sees, in one pass."""
    kinds = [element.kind for element in elements]
    seen = sorted(
        (slot, kinds.index(kind))
        for kind, span in scene.slots.items()
        for slot in range(span.start, span.stop)
        if kind in kinds
    )
    slots, group = torch.tensor(seen, dtype=torch.int64).view(-1, 2).T.contiguous()
    at_origin = [kinds.index(kind) for kind in TASKS[config.task].at_origin if kind in kinds]
    group = torch.cat([group, torch.tensor(at_origin, dtype=torch.int64)])
    # The same at every step, but how many robots there are is known at the first.
    cells = cache(partial(lidar_cells, group, len(kinds), config.lidar_num_bins))
    all_seen = len(slots) == len(scene.names)

    def read(world: World) -> Tensor:
        xy = world.positions[..., :2]
        if not all_seen:
            xy = xy.index_select(1, slots)
        if at_origin:
            xy = torch.cat([xy, xy.new_zeros(len(xy), len(at_origin), 2)], 1)
        return pseudo_lidar(
            floor_to_ego(xy, world.robot_pos, world.robot_mat),
            cells(len(xy)),
            len(kinds),
            config.lidar_num_bins,
            config.lidar_max_dist,
            config.lidar_exp_gain,
            config.lidar_alias,
        )

    return read


def ray_directions(num_rays: int) -> Tensor:
    """Unit vectors in a robot's xy plane, counter-clockwise from its x axis: [R, 3]."""
    angle = 2 * math.pi * torch.arange(num_rays, dtype=torch.float64) / num_rays
    return torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)], -1)


def _natural(
    config: SafetyGymConfig, scene: Scene, elements: list[Element]
) -> Callable[[World], Tensor]:
    """Rays that see one geom group each: exp(-distance), 0 for a miss.

    Kinds of the same group see the same, so each group's rays are cast once. The benchmark's
    quirks are kept: the goal's group is the floor's and the robot's limbs' too, and groups beyond
    MuJoCo's six (the circle's) are never seen.
    """
    rays = ray_directions(config.lidar_num_bins)
    groups = list(dict.fromkeys(element.group for element in elements))
    column = torch.tensor([groups.index(element.group) for element in elements])

    def read_group(world: World, group: int, directions: Tensor) -> Tensor:
        if group >= NUM_RAY_GROUPS:
            return torch.zeros_like(directions[..., 0])
        distance = world.physics.rays(world.robot_pos, directions, group, scene.robot_body)
        return torch.where(distance >= 0, torch.exp(-distance), 0.0)

    def read(world: World) -> Tensor:
        directions = rays @ world.robot_mat.transpose(-1, -2)
        seen = torch.stack([read_group(world, group, directions) for group in groups], 1)
        return seen.index_select(1, column).flatten(1)

    return read


_LIDARS = {"pseudo": _pseudo, "natural": _natural}
