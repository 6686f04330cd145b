"""Pseudo-lidar and compasses: what is where, in the robot's own frame (paper section 4.1.4)."""

from __future__ import annotations

import math
from functools import reduce

import numpy as np
import torch
from torch import Tensor


def _num_laps(num_bins: int) -> int:
    """Turns of the circle that readings are written to, so that no index of a bin has to wrap."""
    return 2 if num_bins > 2 else 4


def to_ego(position: Tensor, robot_pos: Tensor, robot_mat: Tensor) -> Tensor:
    """Rotate positions in the world into the robot's frame.

    Args:
        position: [N, M, 3].
        robot_pos: [N, 3].
        robot_mat: columns are the robot's axes in the world [N, 3, 3].

    Returns:
        [N, M, 3].
    """
    return (position - robot_pos.unsqueeze(-2)) @ robot_mat


def floor_to_ego(xy: Tensor, robot_pos: Tensor, robot_mat: Tensor) -> Tensor:
    """Rotate points on the floor into the robot's frame and leave out z: `to_ego` in fewer passes.

    Args:
        xy: [N, M, 2].
        robot_pos: [N, 3].
        robot_mat: columns are the robot's axes in the world [N, 3, 3].

    Returns:
        [N, M, 2], in memory all x before all y, as the passes that follow want it.
    """
    robot_xy, robot_z = robot_pos.split([2, 1], -1)
    x, y = (xy - robot_xy.unsqueeze(1)).unbind(-1)
    axes = robot_mat[..., :2].permute(1, 2, 0).contiguous()
    along_x, along_y, along_z = axes.unsqueeze(-1).unbind(0)
    ego = torch.addcmul(x * along_x, y, along_y)
    return ego.addcmul_(robot_z, along_z, value=-1).movedim(0, -1)


def lidar_cells(group: Tensor, num_groups: int, num_bins: int, num_robots: int) -> Tensor:
    """Cells that objects straight ahead are written to, in one array for all lidars of all robots.

    Args:
        group: which lidar sees each object, int64 [M] below `num_groups`.
        num_groups: number of lidars, G.
        num_bins: bins over the full circle.
        num_robots: N.

    Returns:
        int64 [N, M]; robot after robot, lidar after lidar, each of several turns of the circle.
    """
    laps = _num_laps(num_bins)
    lidar = num_groups * torch.arange(num_robots).unsqueeze(1) + group
    return (laps * lidar + laps // 2) * num_bins


def pseudo_lidar(
    ego_xy: Tensor,
    cells: Tensor,
    num_groups: int,
    num_bins: int,
    max_dist: float | None,
    exp_gain: float,
    alias: bool,
) -> Tensor:
    """Closeness of the nearest object in every direction, for several kinds of object at once.

    On the CPU, where the worlds are.

    Args:
        ego_xy: objects in the robot's frame [N, M, 2] (m).
        cells: of the objects, from `lidar_cells` [N, M].
        num_groups: number of lidars, G.
        num_bins: bins over the full circle, counter-clockwise from the robot's x axis.
        max_dist: readings fall linearly to 0 at this distance [m]; None: they fall as exp(-gain d).
        exp_gain: that gain [1/m].
        alias: also light the two neighbouring bins, in proportion to where in its bin an object is.

    Returns:
        Readings in [0, 1], [N, G * num_bins].
    """
    x, y = ego_xy.unbind(-1)
    distance = torch.hypot(x, y)
    if max_dist is None:
        reading = torch.exp(-exp_gain * distance)
    else:
        reading = torch.rsub(distance / max_dist, 1.0).relu_()
    # In two steps: then straight behind, either way round, is half of the bins to the last digit.
    turn = torch.atan2(y, x).div_(2 * math.pi).mul_(num_bins)
    bins = turn.floor()
    index = bins.to(torch.int64).add_(cells).flatten().numpy()
    shifted = {1: reading}
    if alias:
        ahead = turn.sub_(bins).mul_(reading)
        shifted |= {2: ahead, 0: reading - ahead}
    shape = (len(reading), num_groups, _num_laps(num_bins), num_bins)
    turns = reading.new_zeros(math.prod(shape) + 2)
    for shift, values in shifted.items():
        # Half the time of torch's scatter_reduce, which branches on every value.
        np.maximum.at(turns.numpy()[shift:], index, values.flatten().numpy())
    return reduce(torch.maximum, turns[1:-1].view(shape).unbind(2)).flatten(1)


def compass(ego: Tensor, num_components: int) -> Tensor:
    """Direction to objects in the robot's frame: [N, K, 3] -> [N, K, 2 or 3], nearly unit."""
    vector = ego[..., :num_components]
    return vector / (torch.linalg.vector_norm(vector, dim=-1, keepdim=True) + 1e-3)
