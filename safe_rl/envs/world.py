"""Named views of the simulated world: what rewards, costs and observations are computed from.

The views are made once. They share memory with the physics, so they are always current, and no
step pays for building them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from safe_rl.envs.physics.base import Physics
from safe_rl.envs.scene import Scene

NO_BUTTON = -1

Shapes = dict[str, tuple[int, ...]]


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
        objects: the same by kind, [N, K, 3].
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
    layout: Tensor
    start_pose: Tensor
    goal_button: Tensor
    buttons_timer: Tensor
    step_count: Tensor

    def at(self, kind: str) -> Tensor:
        """Return the positions of one kind's objects [N, K, 3], a view; K may be 0."""
        return self.objects[kind] if kind in self.objects else self.positions[:, :0]

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
        return self.contacts.get(kind, self.sensordata[:, :0])

    def _slots(self, kind: str) -> slice:
        return self.scene.slots.get(kind, slice(0, 0))


class Block(NamedTuple):
    """Components that are computed together.

    Attributes:
        shapes: shape of each component, in the order of the columns of `read`.
        read: world -> [N, total size].
    """

    shapes: Shapes
    read: Callable[[World], Tensor]


def make_world(scene: Scene, physics: Physics) -> World:
    """Bind the views of a scene to the tensors of a physics backend."""
    num_envs, num_objects = physics.qpos.shape[0], len(scene.names)
    robot, model = scene.robot_body, scene.model
    # In memory all x, then all y, then all z: passes over one coordinate are over one piece.
    positions = torch.zeros(3, num_envs, num_objects, dtype=torch.float64).movedim(0, -1)
    positions[..., 2] = torch.tensor(scene.heights, dtype=torch.float64)
    velocities = physics.qvel[:, scene.robot_nv :].view(num_envs, scene.num_free, 6)[..., :3]
    velocity = int(model.sensor("robot_vel").adr[0])
    return World(
        scene=scene,
        physics=physics,
        robot_pos=physics.xpos[:, robot],
        robot_xy=physics.xpos[:, robot, :2],
        robot_mat=physics.xmat[:, robot],
        com=physics.subtree_com[:, robot],
        up=physics.xmat[:, scene.oriented_body, 2, 2],
        robot_vel=physics.sensordata[:, velocity : velocity + 3],
        positions=positions,
        objects={kind: positions[:, span] for kind, span in scene.slots.items()},
        velocities=velocities,
        contacts={kind: physics.sensordata[:, cols] for kind, cols in scene.contacts.items()},
        qpos=physics.qpos,
        qvel=physics.qvel,
        ctrl=physics.ctrl,
        sensordata=physics.sensordata,
        target_travel=torch.tensor(scene.travel, dtype=torch.float64),
        # Guided objects float at twice the height they start at, see `bodies.add_targets`.
        target_height=2 * positions[0, scene.guided, 2],
        layout=torch.zeros(num_envs, 1 + num_objects, 2, dtype=torch.float64),
        start_pose=torch.zeros(num_envs, 3, dtype=torch.float64),
        goal_button=torch.full((num_envs,), NO_BUTTON),
        buttons_timer=torch.zeros(num_envs, dtype=torch.int64),
        step_count=torch.zeros(num_envs, dtype=torch.int64),
    )


def refresh(world: World) -> None:
    """Copy the positions of the free bodies from the physics."""
    scene = world.scene
    if scene.num_free:
        world.positions[:, : scene.num_free] = world.physics.xpos[:, scene.free_bodies]


def yaw_quaternion(yaw: Tensor) -> Tensor:
    """Rotations about z by yaw [...] as quaternions (w, x, y, z) [..., 4]."""
    zero = torch.zeros_like(yaw)
    return torch.stack([torch.cos(yaw / 2), zero, zero, torch.sin(yaw / 2)], -1)


def circling_targets(
    centres: Tensor,
    time: Tensor,
    travel: Tensor | float,
    height: Tensor | float,
    timestep: float,
    num_substeps: int,
) -> Tensor:
    """Positions of the gremlins' targets before each substep (circles of radius `travel`).

    Args:
        centres: where the gremlins were placed [N, K, 2].
        time: simulation time before the first substep [N].
        travel: radius of the circle [m], for all or for each [K].
        height: z of the targets [m], for all or for each [K].
        timestep: length of a substep [s].
        num_substeps: S.

    Returns:
        [N, S, K, 3]; at time 0 a target stands at +travel along y.
    """
    steps = torch.arange(num_substeps, dtype=time.dtype)
    phase = (time.unsqueeze(-1) + timestep * steps)[..., None]
    radius = torch.as_tensor(travel, dtype=time.dtype).unsqueeze(-1)
    offset = radius * torch.stack([torch.sin(phase), torch.cos(phase)], -1)
    targets = centres.unsqueeze(1) + offset
    z = torch.as_tensor(height, dtype=time.dtype).expand(targets.shape[:-1])
    return torch.cat([targets, z.unsqueeze(-1)], -1)
