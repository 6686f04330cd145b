"""The two kinds of lidar as parts of the observation (paper section 4.1.4).

Pseudo-lidar computes bearings and distances of object centres; natural lidar casts rays into the
physics and sees surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from safe_rl.envs.config import SafetyGymConfig
from safe_rl.envs.elements import ELEMENTS, NUM_RAY_GROUPS, Element
from safe_rl.envs.lidar import pseudo_lidar, to_ego
from safe_rl.envs.scene import Scene
from safe_rl.envs.world import Block, World


def lidar_blocks(config: SafetyGymConfig, scene: Scene) -> list[Block]:
    """All lidars of a configuration, as one block."""
    elements = [element for element in ELEMENTS if element.observed(config)]
    if not elements:
        return []
    read = _LIDARS[config.lidar_type](config, scene, elements)
    bins, kinds = config.lidar_num_bins, [element.kind for element in elements]
    asleep = slice(0, 0)
    if "buttons" in kinds:
        first = kinds.index("buttons") * bins
        asleep = slice(first, first + bins)

    def read_awake(world: World) -> Tensor:
        readings = read(world)
        readings[:, asleep] *= (world.buttons_timer == 0).unsqueeze(-1)
        return readings

    return [Block({f"{kind}_lidar": (bins,) for kind in kinds}, read_awake)]


def _pseudo(
    config: SafetyGymConfig, scene: Scene, elements: list[Element]
) -> Callable[[World], Tensor]:
    """Every object that any lidar sees, in one pass."""
    kinds = [element.kind for element in elements]
    seen = [(scene.slots[kind], i) for i, kind in enumerate(kinds) if kind in scene.slots]
    pairs = [(slot, i) for span, i in seen for slot in range(span.start, span.stop)]
    # Without any object the index is empty, and has to be one of integers all the same.
    slots, group = torch.tensor(pairs, dtype=torch.int64).view(-1, 2).T.contiguous()
    on_floor = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)

    def read(world: World) -> Tensor:
        objects = world.positions.index_select(1, slots) * on_floor
        ego = to_ego(objects, world.robot_pos, world.robot_mat)
        return pseudo_lidar(
            ego[..., :2],
            group,
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
