"""Records of a compiled world: indices into its arrays, and named views of its state."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
from torch import Tensor

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.physics import Physics
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.naming import did_you_mean


@dataclass(frozen=True)
class Scene:
    """A compiled world, and the indices of its objects.

    Attributes:
        config: The configuration from which it was built.
        model: The compiled model.
        names: Name of every object, by slot. Slots are the index M of `[N, M, …]` tensors.
        slots: Slots of each kind that has objects.
        kinds: Names of all kinds, also of those without objects.
        heights: z of every object's centre [m], by slot.
        num_free: Slots below this number are free bodies. Each has 7 columns of `qpos` and 6 of
            `qvel`, after the robot's.
        num_mocap_slots: Number of slots from `num_free` on that are mocap bodies; in MuJoCo these
            come after the targets.
        guided: Slots of the bodies that are welded to a target which moves in a circle.
        num_targets: Number of those targets, the first mocap bodies.
        travel: Radius of each target's circle [m], by guided slot.
        robot_body: Body id of the robot's root.
        robot_sensors: Number of sensors in the robot's file, which come first.
        robot_nq, robot_nv: Number of the robot's columns in `qpos` and `qvel`, which come first.
        planar: Whether the root is (x, y, yaw) instead of a free joint.
        oriented_body: Body id of the robot's part for `reward_orientation`.
        free_bodies: Body ids of the free slots.
        contacts: `sensordata` columns of each kind's contact counts with the robot.
    """

    config: SafetyGymConfig
    model: mujoco.MjModel
    names: tuple[str, ...]
    slots: Mapping[str, slice]
    kinds: tuple[str, ...]
    heights: tuple[float, ...]
    num_free: int
    num_mocap_slots: int
    guided: slice
    num_targets: int
    travel: tuple[float, ...]
    robot_body: int
    robot_sensors: int
    robot_nq: int
    robot_nv: int
    planar: bool
    oriented_body: int
    free_bodies: slice
    contacts: Mapping[str, slice]


NO_BUTTON = -1

Shapes = dict[str, tuple[int, ...]]
Bounds = tuple[float, float]
UNBOUNDED: Bounds = (-math.inf, math.inf)


@dataclass(frozen=True)
class World:
    """N worlds of one scene; M objects by slot, K of one kind. Metres, seconds, float64.

    Attributes:
        scene: The compiled world.
        physics: The backend that runs the simulations.
        robot_pos, robot_xy: Position of the robot body [N, 3], and its x and y [N, 2].
        robot_mat: Its rotation; columns are its axes in the world [N, 3, 3].
        com: Centre of mass of the robot with its limbs [N, 3].
        up: z component of the z axis of the body for `reward_orientation` [N].
        robot_vel: Linear velocity of the robot body [N, 3].
        positions: Centres of all objects [N, M, 3], updated by `refresh`. They are not contiguous,
            so use `flatten` instead of `view`.
        objects: The same by kind, [N, K, 3]; also kinds that a task observes at the origin.
        velocities: Linear velocities of the free bodies [N, F, 3].
        contacts: Number of contact points of the robot with each object of a kind, [N, K].
        qpos, qvel, ctrl, sensordata: The arrays of MuJoCo, [N, ·].
        target_travel, target_height: Radius and height of the targets of guided objects [G] (m).
        pinned_yaws: Fixed yaws of robot and free bodies, NaN where they are drawn [1 + F].
        layout: Positions at the start of the episode, and of the newest goal [N, 1 + M, 2].
        start_pose: (x, y, yaw) of the robot at the start of the episode [N, 3].
        goal_button: Index of the goal button, -1 if there is none, int64 [N].
        buttons_timer: Steps until buttons have an effect again, int64 [N].
        step_count: Steps taken in this episode, int64 [N].
    """

    scene: Scene
    physics: Physics
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
    pinned_yaws: Tensor
    layout: Tensor
    start_pose: Tensor
    goal_button: Tensor
    buttons_timer: Tensor
    step_count: Tensor

    def at(self, kind: str) -> Tensor:
        """Return the positions of one kind's objects [N, K, 3], a view; K may be 0.

        Raises:
            ConfigError: Here and in the next methods, if the kind does not exist.
        """
        if kind in self.objects:
            return self.objects[kind]
        return self.positions[:, self._slots(kind)]

    def start_of(self, kind: str) -> Tensor:
        """Return one kind's positions at the start of the episode [N, K, 2], a view."""
        slots = self._slots(kind)
        return self.layout[:, 1 + slots.start : 1 + slots.stop]

    def velocity_of(self, kind: str) -> Tensor:
        """Return linear velocities of one kind's free bodies [N, K, 3], a view."""
        if (slots := self._slots(kind)).stop > self.scene.num_free:
            raise ConfigError(f"'{kind}' are not free bodies, so they have no velocity.")
        return self.velocities[:, slots]

    def contacts_with(self, kind: str) -> Tensor:
        """Return the number of the robot's contacts with each object of a kind [N, K], a view.

        Raises:
            KeyError: If they are not counted.
        """
        if kind in self.contacts:
            return self.contacts[kind]
        if kind in self.scene.slots:
            raise KeyError(
                f"Contacts with '{kind}' are not counted: list it in 'touches' of the task, cost "
                "or observation that reads them. Areas (Motion.VIRTUAL) have no contacts."
            )
        return self.sensordata[:, self._slots(kind)]

    def require(self, what: str, values: Any, *size: int) -> Tensor:
        """Return values unchanged; ConfigError unless they are a tensor [N, *size]."""
        shape = (len(self.step_count), *size)
        if isinstance(values, Tensor) and values.shape == shape:
            return values
        got = list(values.shape) if isinstance(values, Tensor) else f"a {type(values).__name__}"
        raise ConfigError(
            f"{what} must be a tensor {list(shape)}, with a row for every world, got {got}."
        )

    def _slots(self, kind: str) -> slice:
        if kind not in (kinds := self.scene.kinds):
            hint = f"{did_you_mean(kind, kinds)} There are {', '.join(kinds)}."
            raise ConfigError(f"There is no kind '{kind}' of objects.{hint}")
        return self.scene.slots.get(kind, slice(0, 0))


class Block(NamedTuple):
    """Components of the observation that are computed together.

    Attributes:
        shapes: Shape of each component, in the order of the columns of `read`.
        read: World -> [N, total size].
        bounds: Lowest and highest value of all of them.
    """

    shapes: Shapes
    read: Callable[[World], Tensor]
    bounds: Bounds = UNBOUNDED
