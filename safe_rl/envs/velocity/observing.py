"""What the robots observe, as Gymnasium's environments of version 5 have it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import torch
from torch import Tensor

from safe_rl.envs.physics.batch import BatchPhysics
from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.model import FORCES, observed_parts
from safe_rl.envs.velocity.robots import ROBOTS


class Part(NamedTuple):
    """A named component: how many numbers, and how to read them, float64 [N, size]."""

    name: str
    size: int
    read: Callable[[BatchPhysics], Tensor]


class Observer:
    """Reads the observation, a flat vector of named components.

    Args:
        config: the environment.
        model: its compiled model.

    Attributes:
        columns: of every component.
        size: number of columns.
    """

    def __init__(self, config: VelocityConfig, model: mujoco.MjModel) -> None:
        self._parts = [*_joints(config, model), *_bodies(config, model)]
        self.columns: dict[str, slice] = {}
        self.size = 0
        for part in self._parts:
            self.columns[part.name] = slice(self.size, self.size + part.size)
            self.size += part.size

    def write(self, physics: BatchPhysics, observation: Tensor) -> None:
        """Write what all robots observe after a step into [N, size]."""
        for part in self._parts:
            observation[:, self.columns[part.name]] = part.read(physics)

    def write_start(self, physics: BatchPhysics, observation: Tensor, rows: Tensor) -> None:
        """Write what some robots (int64 [R]) observe where no step was taken: no contact forces.

        Gymnasium computes contact forces after steps only.
        """
        for part in self._parts:
            columns = self.columns[part.name]
            start = 0.0 if part.name == FORCES else part.read(physics)[rows].to(observation.dtype)
            observation[rows, columns] = start


def _joints(config: VelocityConfig, model: mujoco.MjModel) -> list[Part]:
    robot = ROBOTS[config.robot]
    first = robot.num_hidden if config.exclude_current_positions_from_observation else 0
    limit = robot.velocity_limit
    return [
        Part("qpos", model.nq - first, lambda physics: physics.qpos[:, first:]),
        Part("qvel", model.nv, lambda physics: physics.qvel.clamp(-limit, limit)),
    ]


def _bodies(config: VelocityConfig, model: mujoco.MjModel) -> list[Part]:
    """Components about bodies, without the world's, and forces of all joints but the root."""
    low, high = config.contact_force_range or (-torch.inf, torch.inf)
    moving = model.nbody - 1
    known = {
        "cinert": Part("cinert", 10 * moving, lambda p: p.outputs["cinert"][:, 1:].flatten(1)),
        "cvel": Part("cvel", 6 * moving, lambda p: p.outputs["cvel"][:, 1:].flatten(1)),
        "qfrc_actuator": Part(
            "qfrc_actuator", model.nv - 6, lambda p: p.outputs["qfrc_actuator"][:, 6:]
        ),
        FORCES: Part(
            FORCES, 6 * moving, lambda p: p.outputs[FORCES][:, 1:].flatten(1).clamp(low, high)
        ),
    }
    return [known[name] for name in observed_parts(config)]
