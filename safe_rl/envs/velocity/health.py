"""When a robot stands as it should: functions over positions and velocities, one per robot.

As the `is_healthy` of Gymnasium's environments of version 5, bounds included or not as there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from safe_rl.envs.velocity.config import Range, VelocityConfig

Health = Callable[[VelocityConfig, Tensor, Tensor], Tensor]


def _inside(value: Tensor, interval: Range | None) -> Tensor:
    assert interval is not None
    low, high = interval
    return (low < value) & (value < high)


def hopper(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Torso high and upright, everything else within bounds: [N, nq], [N, nv] -> bool [N]."""
    state = torch.cat([qpos[:, 2:], qvel], -1)
    return walker2d(config, qpos, qvel) & _inside(state, config.healthy_state_range).all(-1)


def walker2d(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Torso high and upright: [N, nq], [N, nv] -> bool [N]."""
    upright = _inside(qpos[:, 2], config.healthy_angle_range)
    return _inside(qpos[:, 1], config.healthy_z_range) & upright


def ant(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Torso neither on the ground nor in the air, bounds included: -> bool [N]."""
    assert config.healthy_z_range is not None
    low, high = config.healthy_z_range
    finite = qpos.isfinite().all(-1) & qvel.isfinite().all(-1)
    return finite & (low <= qpos[:, 2]) & (qpos[:, 2] <= high)


def humanoid(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Torso high: [N, nq], [N, nv] -> bool [N]."""
    return _inside(qpos[:, 2], config.healthy_z_range)


HEALTH: Mapping[str, Health] = {
    "hopper": hopper,
    "walker2d": walker2d,
    "ant": ant,
    "humanoid": humanoid,
}
