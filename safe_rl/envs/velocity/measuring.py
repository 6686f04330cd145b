"""Where a robot is, for its velocity: displacement of a place over a step, by the step's duration.

Places are as Gymnasium has them: derived ones (`torso`, `centre_of_mass`) are those that `mj_step`
leaves behind, of the state that the last substep evaluated last.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import mujoco
import torch
from torch import Tensor

from safe_rl.envs.physics.batch import BatchPhysics

TORSO = 1  # id of its body: every robot's first


class Place(NamedTuple):
    """A place: the outputs it needs, and how to make its reading of physics [N, D] (m)."""

    outputs: tuple[str, ...]
    reading: Callable[[mujoco.MjModel, BatchPhysics], Callable[[], Tensor]]


def _x(model: mujoco.MjModel, physics: BatchPhysics) -> Callable[[], Tensor]:
    return lambda: physics.qpos[:, :1].clone()


def _torso(model: mujoco.MjModel, physics: BatchPhysics) -> Callable[[], Tensor]:
    return lambda: physics.outputs["xpos"][:, TORSO, :2].clone()


def _centre_of_mass(model: mujoco.MjModel, physics: BatchPhysics) -> Callable[[], Tensor]:
    shares = torch.from_numpy(model.body_mass / model.body_mass.sum())[:, None]
    return lambda: (physics.outputs["xipos"][..., :2] * shares).sum(1)


# D is 1 where the velocity along x is limited, 2 where the speed in the plane is.
PLACES: Mapping[str, Place] = {
    "x": Place((), _x),
    "torso": Place(("xpos",), _torso),
    "centre_of_mass": Place(("xipos",), _centre_of_mass),
}


def limited_speed(velocity: Tensor) -> Tensor:
    """What the threshold applies to: x velocity, or the speed in the plane; [N, D] -> [N].

    As in Safety-Gymnasium: driving backwards along x costs nothing, in the plane it does.

    Examples:
        >>> limited_speed(torch.tensor([[-3.0]])).item()
        -3.0
        >>> limited_speed(torch.tensor([[-3.0, 4.0]])).item()
        5.0
    """
    return velocity[:, 0] if velocity.shape[-1] == 1 else velocity.square().sum(-1).sqrt()
