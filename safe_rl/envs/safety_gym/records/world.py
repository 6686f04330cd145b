"""Named views of the simulated world: what rewards, costs and observations are computed from."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.physics.batch import BatchPhysics
from safe_rl.envs.safety_gym.records.scene import Scene

NO_BUTTON = -1

Shapes = dict[str, tuple[int, ...]]
Bounds = tuple[float, float]
UNBOUNDED: Bounds = (-math.inf, math.inf)


@dataclass(frozen=True)
class World:
    """N worlds of one scene; M objects by slot, K of one kind. Metres, seconds, float64.

    Attributes:
        robot_pos, robot_xy: position of the robot body [N, 3], and where it is on the floor [N, 2].
        robot_mat: its rotation, columns are its axes in the world [N, 3, 3].
        com: centre of mass of the robot with its limbs [N, 3].
        up: z component of the z axis of the body that `reward_orientation` looks at [N].
        robot_vel: linear velocity of the robot body [N, 3].
        positions: centres of all objects [N, M, 3], brought up to date by `refresh`; not
            contiguous, so `flatten` them instead of asking for a `view`.
        objects: the same by kind, [N, K, 3]; also of what a task observes at the origin.
        velocities: linear velocities of the free bodies [N, F, 3].
        contacts: contact points of the robot with each object of a kind, [N, K].
        qpos, qvel, ctrl, sensordata: as MuJoCo has them, [N, ·].
        target_travel, target_height: of the circles that guided objects run on [G] (m).
        layout: positions at the start of the episode and of the newest goal [N, 1 + M, 2].
        start_pose: (x, y, yaw) of the robot at the start of the episode [N, 3].
        goal_button: index of the goal button, -1 where there is none, int64 [N].
        buttons_timer: steps until the buttons wake up, int64 [N].
        step_count: steps taken in this episode, int64 [N].
    """

    scene: Scene
    physics: BatchPhysics
    robot_pos: Tensor
    robot_xy: Tensor
    robot_mat: Tensor
    com: Tensor
    up: Tensor
    robot_vel: Tensor
    positions: Tensor
    objects: Mapping[str, Tensor]
    velocities: Tensor
    contacts: Mapping[str, Tensor]
    qpos: Tensor
    qvel: Tensor
    ctrl: Tensor
    sensordata: Tensor
    target_travel: Tensor
    target_height: Tensor
    layout: Tensor
    start_pose: Tensor
    goal_button: Tensor
    buttons_timer: Tensor
    step_count: Tensor

    def at(self, kind: str) -> Tensor:
        """Return the positions of one kind's objects [N, K, 3], a view; K may be 0.

        Raises:
            ConfigError: here and below, if there is no such kind.
        """
        if kind in self.objects:
            return self.objects[kind]
        return self.positions[:, self._slots(kind)]

    def start_of(self, kind: str) -> Tensor:
        """Return where they were at the start of the episode [N, K, 2], a view."""
        slots = self._slots(kind)
        return self.layout[:, 1 + slots.start : 1 + slots.stop]

    def velocity_of(self, kind: str) -> Tensor:
        """Return linear velocities of one kind's free bodies [N, K, 3], a view."""
        return self.velocities[:, self._slots(kind)]

    def contacts_with(self, kind: str) -> Tensor:
        """Return the robot's contact points with each of one kind's objects [N, K], a view.

        Raises:
            KeyError: if nothing counts them.
        """
        if kind not in self.contacts and kind in self.scene.slots:
            raise KeyError(
                f"Contacts with '{kind}' are not counted: list it in 'touches' of the task, cost "
                "or observation that reads them."
            )
        if kind in self.contacts:
            return self.contacts[kind]
        return self.sensordata[:, self._slots(kind)]

    def _slots(self, kind: str) -> slice:
        if kind not in self.scene.slots and kind not in self.scene.kinds:
            raise ConfigError(
                f"There is no kind '{kind}' of objects.{nearest(kind, self.scene.kinds)} There are "
                f"{', '.join(self.scene.kinds)}."
            )
        return self.scene.slots.get(kind, slice(0, 0))


class Block(NamedTuple):
    """Components that are computed together.

    Attributes:
        shapes: shape of each component, in the order of the columns of `read`.
        read: world -> [N, total size].
        bounds: lowest and highest value of all of them.
    """

    shapes: Shapes
    read: Callable[[World], Tensor]
    bounds: Bounds = UNBOUNDED
