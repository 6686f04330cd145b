"""How episodes start: noise around the model's initial state, addressed by row and episode."""

from __future__ import annotations

from enum import IntEnum

import mujoco
import torch
from torch import Tensor

from safe_rl.envs import rng
from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.robots import ROBOTS


class Purpose(IntEnum):
    """What a random draw is for; part of its address, see `rng`."""

    POSITION = 0
    VELOCITY = 1


def draw_start(config: VelocityConfig, model: mujoco.MjModel, key: Tensor) -> tuple[Tensor, Tensor]:
    """Draw initial positions and velocities, distributed as Gymnasium's.

    Positions are uniform within the noise scale around the model's, velocities uniform within it,
    or normal with it as standard deviation, around 0.

    Args:
        config: the environment.
        model: its compiled model.
        key: random keys, int64 [R].

    Returns:
        Positions [R, nq] and velocities [R, nv], float64.
    """
    scale, keys = config.reset_noise_scale, key[:, None]
    initial = torch.from_numpy(model.qpos0.copy())
    positions = scale * _symmetric(keys, Purpose.POSITION, model.nq)
    if ROBOTS[config.robot].normal_velocities:
        velocities = rng.normal(keys, Purpose.VELOCITY, torch.arange(model.nv))
    else:
        velocities = _symmetric(keys, Purpose.VELOCITY, model.nv)
    return initial + positions, scale * velocities


def _symmetric(keys: Tensor, purpose: Purpose, size: int) -> Tensor:
    """Uniform in [-1, 1): [R, 1] -> [R, size]."""
    return rng.uniform(keys, purpose, torch.arange(size)).mul_(2.0).sub_(1.0)
