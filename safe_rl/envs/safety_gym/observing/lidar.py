"""Pseudo-lidar: what is near in which direction (paper section 4.1.4)."""

from __future__ import annotations

import math
from functools import reduce

import numpy as np
import torch
from torch import Tensor


def _num_laps(num_bins: int) -> int:
    """Turns of the circle that readings are written to, so that no index of a bin has to wrap."""
    return 2 if num_bins > 2 else 4


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
