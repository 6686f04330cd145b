"""Observations that are neither sensors nor lidars: one row each (paper section 4.1.4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gym.geometry import compass, distance, to_ego
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.records.scene import Scene
from safe_rl.envs.safety_gym.records.world import UNBOUNDED, Bounds, World
from safe_rl.envs.safety_gym.rules.tasks import TASKS


class Reading(NamedTuple):
    """A row: one component of the observation.

    Attributes:
        name: of the component.
        present: whether a configuration has it.
        size: number of values.
        read: world -> [N, size].
        touches: kinds whose contacts with the robot it reads.
        bounds: lowest and highest value.
    """

    name: str
    present: Callable[[SafetyGymConfig], bool]
    size: Callable[[SafetyGymConfig, Scene], int]
    read: Callable[[World], Tensor]
    touches: tuple[str, ...] = ()
    bounds: Bounds = UNBOUNDED


def _ego(world: World, kind: str) -> Tensor:
    return to_ego(world.at(kind), world.robot_pos, world.robot_mat)


def _compass_to(kind: str) -> Callable[[World], Tensor]:
    return lambda w: compass(_ego(w, kind), w.scene.config.compass_shape).flatten(1)


def _goal_closeness(world: World) -> Tensor:
    to_goal = distance(world.robot_xy.unsqueeze(1), world.at("goal")[..., :2])
    return torch.exp(-to_goal)


def _remaining(world: World) -> Tensor:
    return (world.step_count / world.scene.config.num_steps).unsqueeze(-1)


def _freejoint_size(config: SafetyGymConfig, scene: Scene) -> int:
    if scene.planar:
        raise ConfigError(
            f"'observe_freejoint': robot '{config.robot_base}' has no free joint. Use "
            "'observe_qpos' instead."
        )
    return 7


def _from_start(world: World, vector: Tensor, moved: bool) -> Tensor:
    """A planar robot's coordinates as seen from where it started: observations know no origin."""
    if not world.scene.planar:
        return vector
    start = world.start_pose if moved else torch.zeros_like(world.start_pose)
    (dx, dy, dyaw) = (vector[:, :3] - start).unbind(-1)
    cos, sin = torch.cos(world.start_pose[:, 2]), torch.sin(world.start_pose[:, 2])
    local = torch.stack([cos * dx + sin * dy, cos * dy - sin * dx, dyaw], -1)
    return torch.cat([local, vector[:, 3:]], -1)


def _has(config: SafetyGymConfig, element: str) -> bool:
    task = TASKS[config.task]
    return element in (*task.elements, *task.at_origin)


READINGS: list[Reading] = [
    Reading(
        "goal_compass",
        lambda c: c.observe_goal_comp and _has(c, "goal"),
        lambda c, s: c.compass_shape,
        _compass_to("goal"),
        bounds=(-1.0, 1.0),
    ),
    Reading(
        "box_compass",
        lambda c: c.observe_box_comp and _has(c, "box"),
        lambda c, s: c.compass_shape,
        _compass_to("box"),
        bounds=(-1.0, 1.0),
    ),
    Reading(
        "goal_dist",
        lambda c: c.observe_goal_dist and _has(c, "goal"),
        lambda c, s: 1,
        _goal_closeness,
        bounds=(0.0, 1.0),
    ),
    Reading("remaining", lambda c: c.observe_remaining, lambda c, s: 1, _remaining),
    Reading("com", lambda c: c.observe_com, lambda c, s: 3, lambda w: w.com),
    Reading("ctrl", lambda c: c.observe_ctrl, lambda c, s: s.model.nu, lambda w: w.ctrl),
    Reading(
        "freejoint",
        lambda c: c.observe_freejoint,
        _freejoint_size,
        lambda w: w.qpos[:, :7],
    ),
    Reading(
        "qpos",
        lambda c: c.observe_qpos,
        lambda c, s: s.model.nq,
        lambda w: _from_start(w, w.qpos, moved=True),
    ),
    Reading(
        "qvel",
        lambda c: c.observe_qvel,
        lambda c, s: s.model.nv,
        lambda w: _from_start(w, w.qvel, moved=False),
    ),
]
