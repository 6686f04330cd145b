"""Geometry of points and bodies: distances, frames, directions, circles.

Lengths are in metres, angles in radians.
"""

from __future__ import annotations

import torch
from torch import Tensor


def distance(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distance over the last dimension."""
    return torch.linalg.vector_norm(a - b, dim=-1)


def to_ego(position: Tensor, robot_pos: Tensor, robot_mat: Tensor) -> Tensor:
    """Transform positions [N, M, 3] into the frames of robots at [N, 3] with axes [N, 3, 3]."""
    return (position - robot_pos.unsqueeze(-2)) @ robot_mat


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


def compass(ego: Tensor, num_components: int) -> Tensor:
    """Directions to objects in the robot's frame, nearly unit vectors: [N, K, 3] -> [N, K, D]."""
    vector = ego[..., :num_components]
    return vector / (torch.linalg.vector_norm(vector, dim=-1, keepdim=True) + 1e-3)


def yaw_quaternion(yaw: Tensor) -> Tensor:
    """Rotations about z by yaw [...] as quaternions (w, x, y, z) [..., 4]."""
    zero = torch.zeros_like(yaw)
    return torch.stack([torch.cos(yaw / 2), zero, zero, torch.sin(yaw / 2)], -1)
