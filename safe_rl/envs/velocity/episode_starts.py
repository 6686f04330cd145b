"""How episodes start: noise around the model's initial state.

Every draw is addressed by its row's seed, the episode and the column of the state, see `rng`.
"""

from __future__ import annotations

import mujoco
import torch
from torch import Tensor

from safe_rl.envs import rng
from safe_rl.envs.velocity.runners import RUNNERS
from safe_rl.envs.velocity.velocity_config import VelocityConfig


class Starts:
    """Starts of episodes, drawn for all rows at once and ahead of need.

    Few rows at a time start an episode, and a draw for few costs as much as one for many. What is
    handed out depends on the row's seed and episode alone.

    Args:
        config: the environment.
        model: its compiled model.
        num_envs: number of rows, N.
    """

    def __init__(self, config: VelocityConfig, model: mujoco.MjModel, num_envs: int) -> None:
        self._config, self._model = config, model
        self._seeds = self._episodes = torch.full((num_envs,), -1)
        self._qpos = torch.zeros(num_envs, model.nq, dtype=torch.float64)
        self._qvel = torch.zeros(num_envs, model.nv, dtype=torch.float64)

    def take(self, seeds: Tensor, episodes: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions [R, nq] and velocities [R, nv] of episodes that start.

        Args:
            seeds: of all rows, int64 [N].
            episodes: that all rows are in, or start, int64 [N].
            rows: which of them start, int64 [R].
        """
        known = torch.equal(self._episodes[rows], episodes[rows])
        if not (known and torch.equal(self._seeds, seeds)):
            self._seeds, self._episodes = seeds.clone(), episodes + 1
            self._episodes[rows] = episodes[rows]
            key = rng.fold(self._seeds, self._episodes)
            self._qpos, self._qvel = draw_start(self._config, self._model, key)
        return self._qpos[rows], self._qvel[rows]


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
    if RUNNERS[config.robot].normal_velocities:
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
