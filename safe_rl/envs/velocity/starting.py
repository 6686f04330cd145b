"""How episodes start: noise around the model's initial state.

Every draw is addressed by its row's seed, the episode and the column of the state, see `rng`.
"""

from __future__ import annotations

import mujoco
import torch
from torch import Tensor

from safe_rl.envs import rng
from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.robots import ROBOTS


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
    columns = torch.arange(model.nq + model.nv)
    if ROBOTS[config.robot].normal_velocities:
        positions = _symmetric(key[:, None], columns[: model.nq])
        velocities = rng.normal(key[:, None], columns[model.nq :])
    else:
        draws = _symmetric(key[:, None], columns)
        positions, velocities = draws.split([model.nq, model.nv], -1)
    initial, scale = torch.from_numpy(model.qpos0.copy()), config.reset_noise_scale
    return initial + scale * positions, scale * velocities


def _symmetric(keys: Tensor, columns: Tensor) -> Tensor:
    """Uniform in [-1, 1): [R, 1], [C] -> [R, C]."""
    return rng.uniform(keys, columns).mul_(2.0).sub_(1.0)
