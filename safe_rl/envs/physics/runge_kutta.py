"""One substep of MuJoCo's Runge-Kutta integrator, stage by stage, with sensors in its last stage.

`mj_step` leaves the derived quantities of the fourth stage, and forces on bodies (`cfrc_ext`) must
be computed from these by a separate call (`mj_rnePostConstraint`). `mujoco.batch` makes this call
only for sensors, and the integrator evaluates sensors only in its first stage. Taking the four
stages one by one needs as many evaluations of the dynamics as `mj_step`, and gives the same numbers
to rounding, forces included.

MuJoCo 4 integrates quaternions on their group: before the velocities of the stages are added,
angular velocities are mapped to the tangent space at the start (Munthe-Kaas 1999; Hairer, Lubich,
Wanner, Geometric Numerical Integration, section IV.8).
"""

from __future__ import annotations

import mujoco
import torch
from torch import Tensor

from safe_rl.envs.physics import BatchPhysics

_STAGES = (0.5, 0.5, 1.0)  # times of the second, third and fourth stage, in substeps
_SMALL_ANGLE = 1e-7  # rad; a lower bound of angles, against divisions by 0
# The product of quaternions p q is (p @ _LEFT) q.
_LEFT = torch.tensor(
    [
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]],
        [[0, 0, -1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, -1, 0, 0]],
        [[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]],
    ],
    dtype=torch.float64,
)


def runge_kutta_substep(physics: BatchPhysics) -> Tensor:
    """Advance by one substep; all outputs, those of sensors included, are of the fourth stage.

    Args:
        physics: Simulations with the output `qacc`. The model is a tree of hinges and slides
            without activations; its first joint is free.

    Returns:
        bool [N]: simulations that failed; they are in the model's initial state.
    """
    qpos, qvel, time = physics.qpos.clone(), physics.qvel.clone(), physics.time.clone()
    step, root = physics.timestep, _Root(qpos[:, 3:7])
    physics.forward(sensors=False)
    travels, accelerations = [qvel], [physics.outputs["qacc"].clone()]
    for part in _STAGES:
        _move(physics.qpos, qpos, travels[-1], part * step, root)
        torch.add(qvel, accelerations[-1], alpha=part * step, out=physics.qvel)
        torch.add(time, part * step, out=physics.time)
        physics.forward(sensors=part == 1.0)
        accelerations.append(physics.outputs["qacc"].clone())
        travels.append(physics.qvel.clone())
        root.pull_back_(travels[-1][:, 3:6])
    physics.qacc_warmstart.copy_(accelerations[-1])
    _move(physics.qpos, qpos, _average(travels), step, root)
    torch.add(qvel, _average(accelerations), alpha=step, out=physics.qvel)
    return _reset_failed(physics)


def _average(stages: list[Tensor]) -> Tensor:
    first, second, third, fourth = stages
    return (second + third).mul_(2.0).add_(first).add_(fourth).div_(6.0)


def _move(moved: Tensor, qpos: Tensor, travel: Tensor, duration: float, root: _Root) -> None:
    """Write positions [N, nq] after a time at velocities [N, nv], as `mj_integratePos` does."""
    torch.add(qpos[:, :3], travel[:, :3], alpha=duration, out=moved[:, :3])
    torch.add(qpos[:, 7:], travel[:, 6:], alpha=duration, out=moved[:, 7:])
    moved[:, 3:7] = root.turn(travel[:, 3:6], duration)


class _Root:
    """Rotations of free roots since the start of the substep, from orientations [N, 4]."""

    def __init__(self, quaternion: Tensor) -> None:
        unit = quaternion / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
        # Matrices of the product from the left; every entry is plus or minus one of four numbers.
        self._product = (unit @ _LEFT.flatten(1)).view(-1, 4, 4)

    def turn(self, angular: Tensor, duration: float) -> Tensor:
        """Turn at a velocity in the root's own axes [N, 3] (rad/s); return quaternions [N, 4]."""
        self._rotation = angular * duration
        angle = torch.linalg.vector_norm(self._rotation, dim=-1, keepdim=True)
        self._angle = angle.clamp_(min=_SMALL_ANGLE)
        half = 0.5 * self._angle
        self._cosine, self._sine = torch.cos(half), torch.sin(half)
        turned = torch.cat([self._cosine, self._rotation * (self._sine / self._angle)], -1)
        return (self._product * turned[:, None]).sum(-1)

    def pull_back_(self, angular: Tensor) -> None:
        """Map velocities after the last turn to coordinates at the start (inverse of dexp)."""
        once = torch.linalg.cross(self._rotation, angular)
        cotangent = (0.5 * self._angle) * (self._cosine / self._sine)
        factor = (1.0 - cotangent) / self._angle.square()
        angular.add_(once, alpha=0.5)
        angular.addcmul_(factor, torch.linalg.cross(self._rotation, once))


def _reset_failed(physics: BatchPhysics) -> Tensor:
    """Reset failed simulations: with a warning of MuJoCo, or not finite or huge numbers."""
    largest = torch.maximum(physics.qpos.abs().amax(-1), physics.qvel.abs().amax(-1))
    failed = physics.failed() | ~(largest < mujoco.mjMAXVAL)  # also where it is not a number
    if failed.any():
        physics.reset(failed)
        physics.forward(failed)
    return failed
