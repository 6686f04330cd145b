"""Position, health and reward of robots: functions over tensors.

Health and reward are those of Gymnasium's environments of version 5 (Towers et al. 2024); intervals
are open or closed as there. The limited speed is that of Safety-Gymnasium (Ji et al. 2023).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import mujoco
import torch
from torch import Tensor

from safe_rl.envs.physics.batch import BatchPhysics
from safe_rl.envs.velocity.velocity_config import Interval, VelocityConfig

TORSO = 1  # id of the torso, the first body of every robot
FORCES = "cfrc_ext"


class Place(NamedTuple):
    """The point whose velocity is limited.

    `torso` and `centre_of_mass` are read as `mj_step` leaves them: they belong to the last state
    that it evaluated.

    Attributes:
        outputs: Outputs of the physics that it needs.
        reading: Returns a function that reads its position [N, D] (m). D is 1 for a limit on the
            velocity along x, and 2 for one on the planar speed.
    """

    outputs: tuple[str, ...]
    reading: Callable[[mujoco.MjModel, BatchPhysics], Callable[[], Tensor]]


def _x(model: mujoco.MjModel, physics: BatchPhysics) -> Callable[[], Tensor]:
    return lambda: physics.qpos[:, :1].clone()


def _torso(model: mujoco.MjModel, physics: BatchPhysics) -> Callable[[], Tensor]:
    return lambda: physics.outputs["xpos"][:, TORSO, :2].clone()


def _centre_of_mass(model: mujoco.MjModel, physics: BatchPhysics) -> Callable[[], Tensor]:
    shares = torch.from_numpy(model.body_mass / model.body_mass.sum())[:, None]
    return lambda: (physics.outputs["xipos"][..., :2] * shares).sum(1)


PLACES: Mapping[str, Place] = {
    "x": Place((), _x),
    "torso": Place(("xpos",), _torso),
    "centre_of_mass": Place(("xipos",), _centre_of_mass),
}


def limited_speed(velocity: Tensor) -> Tensor:
    """Return the limited speed, the x velocity or the planar speed: [N, D] -> [N].

    As in Safety-Gymnasium, the x velocity is signed, so moving backwards costs nothing with it.
    """
    return velocity[:, 0] if velocity.shape[-1] == 1 else velocity.square().sum(-1).sqrt()


def _inside(value: Tensor, interval: Interval | None) -> Tensor:
    assert interval is not None
    low, high = interval
    return (low < value) & (value < high)


# Whether a robot is healthy: configuration, positions [N, nq], velocities [N, nv] -> bool [N].
# Robots that are not in `HEALTH` always are.
def hopper(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Torso high and upright, all other positions and velocities within bounds."""
    state = torch.cat([qpos[:, 2:], qvel], -1)
    return walker2d(config, qpos, qvel) & _inside(state, config.healthy_state_range).all(-1)


def walker2d(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Torso high and upright."""
    upright = _inside(qpos[:, 2], config.healthy_angle_range)
    return _inside(qpos[:, 1], config.healthy_z_range) & upright


def ant(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Height of the torso within a closed interval, and the state finite."""
    assert config.healthy_z_range is not None
    low, high = config.healthy_z_range
    finite = qpos.isfinite().all(-1) & qvel.isfinite().all(-1)
    return finite & (low <= qpos[:, 2]) & (qpos[:, 2] <= high)


def humanoid(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Torso high."""
    return _inside(qpos[:, 2], config.healthy_z_range)


HEALTH: Mapping[str, Callable[[VelocityConfig, Tensor, Tensor], Tensor]] = {
    "hopper": hopper,
    "walker2d": walker2d,
    "ant": ant,
    "humanoid": humanoid,
}


def locomotion_reward(
    config: VelocityConfig,
    velocity_x: Tensor,
    control: Tensor,
    healthy: Tensor,
    outputs: Mapping[str, Tensor],
) -> Tensor:
    """Reward [N] for forward velocity and health, minus costs of control and contact.

    `velocity_x` (m/s) and `healthy` are [N], `control` is [N, nu]. With a contact weight,
    the output `cfrc_ext` [N, nbody, 6] (N m, N) of the physics is read.
    """
    reward = config.forward_reward_weight * velocity_x
    if config.healthy_reward is not None:
        reward = reward + config.healthy_reward * healthy
    reward = reward - config.ctrl_cost_weight * control.square().sum(-1)
    if config.contact_cost_weight:
        forces = outputs[FORCES]
        if config.contact_force_range is not None:
            forces = forces.clamp(*config.contact_force_range)
        cost = config.contact_cost_weight * forces.square().sum((-2, -1))
        if config.contact_cost_range is not None:
            cost = cost.clamp(*config.contact_cost_range)
        reward = reward - cost
    return reward
