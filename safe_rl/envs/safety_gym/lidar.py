"""Lidars: closeness of objects in each direction (paper section 4.1.4).

The pseudo-lidar uses directions and distances of object centres. The natural lidar casts rays in
the physics, which measure the distances of surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial, reduce

import torch
from torch import Tensor

from safe_rl.envs.safety_gym.elements import ELEMENTS, NUM_RAY_GROUPS, Element
from safe_rl.envs.safety_gym.tasks import TASKS
from safe_rl.envs.safety_gym.world import Block, Scene, World


def floor_to_ego(xy: Tensor, robot_pos: Tensor, robot_mat: Tensor) -> Tensor:
    """Transform points on the floor [N, M, 2] into the robot's frame, without z: [N, M, 2].

    In memory all x are before all y, which makes later operations on one coordinate faster.
    """
    robot_xy, robot_z = robot_pos.split([2, 1], -1)
    x, y = (xy - robot_xy.unsqueeze(1)).unbind(-1)
    axes = robot_mat[..., :2].permute(1, 2, 0).contiguous()
    along_x, along_y, along_z = axes.unsqueeze(-1).unbind(0)
    ego = torch.addcmul(x * along_x, y, along_y)
    return ego.addcmul_(robot_z, along_z, value=-1).movedim(0, -1)


def _num_laps(num_bins: int) -> int:
    """Return how often the circle is repeated in a lidar's cells, so that no bin lies outside."""
    return 2 if num_bins > 2 else 4


def lidar_cells(group: Tensor, num_groups: int, num_bins: int, num_robots: int) -> Tensor:
    """Return the cells of the first bins, in one array for all lidars of all robots.

    `group`, int64 [M], is the lidar (of G) that sees each object. The result, int64 [3, N, M], is
    for an object in the first bin of its lidar: it has the cell of the bin before that one, of the
    bin itself, and of the one after. Cells are ordered by robot, then by lidar; each lidar has
    several turns of the circle.
    """
    laps = _num_laps(num_bins)
    robot = torch.arange(num_robots, device=group.device).unsqueeze(1)
    cells = (laps * (num_groups * robot + group) + laps // 2) * num_bins
    return torch.stack([cells, cells + 1, cells + 2])


def pseudo_lidar(
    ego_xy: Tensor,
    cells: Tensor,
    num_groups: int,
    num_bins: int,
    max_dist: float | None,
    exp_gain: float,
    alias: bool,
) -> Tensor:
    """Return the closeness of the nearest object in every direction, for several lidars at once.

    Args:
        ego_xy: Objects in the robot's frame [N, M, 2] (m).
        cells: Cells of the objects, from `lidar_cells` [3, N, M].
        num_groups: Number of lidars, G.
        num_bins: Bins over the full circle, counter-clockwise from the robot's x axis.
        max_dist: Readings fall linearly to 0 at this distance [m]; None: they fall as exp(-gain d).
        exp_gain: The gain [1/m] if `max_dist` is None.
        alias: An object also raises the two bins next to its own, in proportion to its position
            within its bin.

    Returns:
        Readings in [0, 1], [N, G * num_bins].
    """
    x, y = ego_xy.unbind(-1)
    distance = torch.hypot(x, y)
    if max_dist is None:
        reading = torch.exp(-exp_gain * distance)
    else:
        reading = torch.rsub(distance / max_dist, 1.0).relu_()
    # In two steps, so that ±π gives exactly half of the bins.
    turn = torch.atan2(y, x).div_(2 * math.pi).mul_(num_bins)
    bins = turn.floor()
    values = reading.unsqueeze(0)
    if alias:
        after = turn.sub_(bins).mul_(reading)
        values = torch.stack([reading - after, reading, after])
    else:
        cells = cells[1:2]
    index = (bins.to(torch.int64) + cells).flatten()
    shape = (len(x), num_groups, _num_laps(num_bins), num_bins)
    turns = reading.new_zeros(math.prod(shape) + 2)
    turns.scatter_reduce_(0, index, values.flatten(), "amax")
    return reduce(torch.maximum, turns[1:-1].view(shape).unbind(2)).flatten(1)


def lidar_blocks(scene: Scene, device: torch.device) -> list[Block]:
    """Return all lidars of a configuration as one block; no block if there is no lidar."""
    config = scene.config
    existing = (*scene.slots, *TASKS[config.task].at_origin)
    elements = [
        element
        for element in ELEMENTS
        if getattr(config, element.flag or f"observe_{element.kind}")
        and (element.always_observed or element.kind in existing)
    ]
    if not elements:
        return []
    make = _pseudo if config.lidar_type == "pseudo" else _natural
    read = make(scene, elements, device)
    bins, kinds = config.lidar_num_bins, [element.kind for element in elements]
    if "buttons" in kinds:
        first = kinds.index("buttons") * bins
        read = partial(_read_awake, read, slice(first, first + bins))
    return [Block({f"{kind}_lidar": (bins,) for kind in kinds}, read, (0.0, 1.0))]


def _read_awake(read: Callable[[World], Tensor], columns: slice, world: World) -> Tensor:
    """Return readings whose columns of buttons are 0 while their timer runs after a goal."""
    readings = read(world)
    readings[:, columns] *= (world.buttons_timer == 0).unsqueeze(-1)
    return readings


def _pseudo(
    scene: Scene, elements: list[Element], device: torch.device
) -> Callable[[World], Tensor]:
    """Return a function that reads all lidars in one pass over the objects that they see."""
    config = scene.config
    kinds = [element.kind for element in elements]
    seen = sorted(
        (slot, kinds.index(kind))
        for kind, span in scene.slots.items()
        for slot in range(span.start, span.stop)
        if kind in kinds
    )
    pairs = torch.tensor(seen, dtype=torch.int64, device=device)
    slots, group = pairs.view(-1, 2).T.contiguous()
    at_origin = [kinds.index(kind) for kind in TASKS[config.task].at_origin if kind in kinds]
    group = torch.cat([group, group.new_tensor(at_origin)])
    # They are the same at every step; the number of robots is known at the first step.
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


def _natural(
    scene: Scene, elements: list[Element], device: torch.device
) -> Callable[[World], Tensor]:
    """Return a function that casts rays, each at one geom group: exp(-distance), 0 for a miss.

    Peculiarities of the benchmark are kept: the floor and the robot's limbs have the goal's group;
    groups beyond MuJoCo's six (the circle's) are never seen; rays pass above hazards;
    `lidar_max_dist`, `lidar_exp_gain` and `lidar_alias` have no effect.
    """
    num_rays = scene.config.lidar_num_bins
    angle = 2 * math.pi * torch.arange(num_rays, dtype=torch.float64) / num_rays
    # in the robot's xy plane, counter-clockwise from its x axis
    rays = torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)], -1).to(device)
    groups = list(dict.fromkeys(element.group for element in elements))
    column = torch.tensor([groups.index(element.group) for element in elements], device=device)

    def read_group(world: World, group: int, directions: Tensor) -> Tensor:
        if group >= NUM_RAY_GROUPS:
            return torch.zeros_like(directions[..., 0])
        distance = world.physics.rays(world.robot_pos, directions, group, scene.robot_body)
        return torch.where(distance >= 0, torch.exp(-distance), 0.0)

    def read(world: World) -> Tensor:
        directions = rays.to(world.robot_mat.dtype) @ world.robot_mat.transpose(-1, -2)
        seen = torch.stack([read_group(world, group, directions) for group in groups], 1)
        return seen.index_select(1, column).flatten(1)

    return read
