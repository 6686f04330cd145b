"""One substep of MuJoCo's Runge-Kutta integrator, stage by stage, with sensors in its last stage.

`mj_step` leaves the derived quantities of the fourth stage behind, and forces on bodies
(`cfrc_ext`) are computed from those by a call of their own (`mj_rnePostConstraint`), which
`mujoco.batch` makes for sensors only, and integrators for no stage but the first. Taking the four
stages one by one costs as many evaluations of the dynamics as `mj_step` and gives the same numbers
to rounding, forces included.

MuJoCo 4 integrates quaternions on their group: where a classical scheme adds up stage velocities,
angular velocities are mapped to the tangent space at the start (Munthe-Kaas 1999; Hairer, Lubich,
Wanner, Geometric Numerical Integration, section IV.8).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from safe_rl.envs.physics.base import Physics

_STAGES = (0.5, 0.5, 1.0)  # how far into the substep the second, third and fourth stage look
_HUGE = 1e10  # MuJoCo's mjMAXVAL: larger numbers are a simulation that failed
_SMALL_ANGLE = 1e-3  # rad; below it the factor in `_pull_back` is constant to rounding


def runge_kutta_substep(physics: Physics) -> Tensor:
    """Advance by one substep; outputs are those of the fourth stage, also what sensors make.

    Args:
        physics: simulations with `qacc` among their outputs, of a tree of hinges and slides whose
            first joint may be free, without activations.

    Returns:
        bool [N]: simulations that failed; they are in the model's initial state.
    """
    step, free = physics.timestep, physics.qpos.shape[-1] == physics.qvel.shape[-1] + 1
    qpos, qvel, time = _unit(physics.qpos, free), physics.qvel.clone(), physics.time.clone()
    physics.forward(sensors=False)
    travels, accelerations = [qvel], [physics.outputs["qacc"].clone()]
    for part in _STAGES:
        tangent = part * step * travels[-1]
        physics.qpos.copy_(_move(qpos, tangent, free))
        physics.qvel.copy_(qvel + part * step * accelerations[-1])
        physics.time.copy_(time + part * step)
        physics.forward(sensors=part == 1.0)
        accelerations.append(physics.outputs["qacc"].clone())
        travels.append(_pull_back(physics.qvel, tangent, free))
    physics.qacc_warmstart.copy_(accelerations[-1])
    physics.qpos.copy_(_move(qpos, step * _average(travels), free))
    physics.qvel.copy_(qvel + step * _average(accelerations))
    return _reset_failed(physics)


def _average(stages: list[Tensor]) -> Tensor:
    first, second, third, fourth = stages
    return (first + fourth + 2.0 * (second + third)) / 6.0


def _unit(qpos: Tensor, free: bool) -> Tensor:
    """Copy positions [N, nq], with a root quaternion of length 1."""
    qpos = qpos.clone()
    if free:
        qpos[:, 3:7] /= torch.linalg.vector_norm(qpos[:, 3:7], dim=-1, keepdim=True)
    return qpos


def _move(qpos: Tensor, tangent: Tensor, free: bool) -> Tensor:
    """Move positions [N, nq] along a tangent vector [N, nv], as `mj_integratePos` does."""
    if not free:
        return qpos + tangent
    turned = _multiply(qpos[:, 3:7], _exponential(tangent[:, 3:6]))
    return torch.cat([qpos[:, :3] + tangent[:, :3], turned, qpos[:, 7:] + tangent[:, 6:]], -1)


def _exponential(rotation: Tensor) -> Tensor:
    """Unit quaternions of rotation vectors [N, 3] -> [N, 4]."""
    angle = torch.linalg.vector_norm(rotation, dim=-1, keepdim=True)
    vector = torch.sinc(angle / (2.0 * math.pi)) * (0.5 * rotation)
    return torch.cat([torch.cos(0.5 * angle), vector], -1)


def _multiply(left: Tensor, right: Tensor) -> Tensor:
    """Products of quaternions [N, 4]."""
    left_scalar, left_vector = left[:, :1], left[:, 1:]
    right_scalar, right_vector = right[:, :1], right[:, 1:]
    scalar = left_scalar * right_scalar - (left_vector * right_vector).sum(-1, keepdim=True)
    turned = torch.linalg.cross(left_vector, right_vector)
    return torch.cat([scalar, turned + left_scalar * right_vector + right_scalar * left_vector], -1)


def _pull_back(qvel: Tensor, tangent: Tensor, free: bool) -> Tensor:
    """Velocities at the end of a tangent, in the coordinates of its start (inverse of dexp)."""
    moved = qvel.clone()
    if free:
        rotation = tangent[:, 3:6]
        once = torch.linalg.cross(rotation, qvel[:, 3:6])
        angle = torch.linalg.vector_norm(rotation, dim=-1, keepdim=True).clamp(min=_SMALL_ANGLE)
        half = 0.5 * angle
        factor = (1.0 - half / torch.tan(half)) / angle.square()
        moved[:, 3:6] += 0.5 * once + factor * torch.linalg.cross(rotation, once)
    return moved


def _reset_failed(physics: Physics) -> Tensor:
    """Set simulations that failed to the model's initial state: warned of, not finite or huge."""
    largest = torch.maximum(physics.qpos.abs().amax(-1), physics.qvel.abs().amax(-1))
    failed = physics.failed() | ~(largest < _HUGE)  # also where it is not a number
    if failed.any():
        physics.reset(failed)
        physics.forward(failed)
    return failed
