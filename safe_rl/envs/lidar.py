"""Pseudo-lidar and compasses: what is where, in the robot's own frame (paper section 4.1.4)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


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


def pseudo_lidar(
    ego_xy: Tensor,
    group: Tensor,
    num_groups: int,
    num_bins: int,
    max_dist: float | None,
    exp_gain: float,
    alias: bool,
) -> Tensor:
    """Closeness of the nearest object in every direction, for several kinds of object at once.

    Args:
        ego_xy: objects in the robot's frame [N, M, 2] (m).
        group: which lidar sees each object, int64 [M] below `num_groups`.
        num_groups: number of lidars, G.
        num_bins: bins over the full circle, counter-clockwise from the robot's x axis.
        max_dist: readings fall linearly to 0 at this distance [m]; None: they fall as exp(-gain d).
        exp_gain: that gain [1/m].
        alias: also light the two neighbouring bins, in proportion to where in its bin an object is.

    Returns:
        Readings in [0, 1], [N, G * num_bins].
    """
    x, y = ego_xy.unbind(-1)
    distance = torch.sqrt(x * x + y * y)
    if max_dist is None:
        reading = torch.exp(-exp_gain * distance)
    else:
        reading = (1.0 - distance / max_dist).clamp_(min=0.0)
    turn = torch.remainder(torch.atan2(y, x), 2 * math.pi) * (num_bins / (2 * math.pi))
    # A bearing just below the x axis may round up to a full turn.
    bins = turn.floor().clamp_(max=num_bins - 1)
    index, first = bins.to(torch.int64), group * num_bins
    cells, values = [index + first], [reading]
    if alias:
        part = turn - bins
        cells += [(index + 1) % num_bins + first, (index - 1) % num_bins + first]
        values += [part * reading, (1.0 - part) * reading]
    empty = reading.new_zeros(len(reading), num_groups * num_bins)
    return empty.scatter_reduce_(1, torch.cat(cells, 1), torch.cat(values, 1), "amax")


def compass(ego: Tensor, num_components: int) -> Tensor:
    """Direction to objects in the robot's frame: [N, K, 3] -> [N, K, 2 or 3], nearly unit."""
    vector = ego[..., :num_components]
    return vector / (torch.linalg.vector_norm(vector, dim=-1, keepdim=True) + 1e-3)
