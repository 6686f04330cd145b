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
        robot_pos: position of the robot body [N, 3].
        robot_mat: its rotation, columns are its axes in the world [N, 3, 3].
        com: centre of mass of the robot with its limbs [N, 3].
        up: z component of the z axis of the body that `reward_orientation` looks at [N].
        velocity: linear velocity of the robot body [N, 3]; only in the circle task.
        positions: centres of all objects [N, M, 3], brought up to date by `refresh`.
        contacts: contact points of the robot with each object of a kind, [N, K].
        vase_velocity: linear velocities of the vases [N, K, 3].
        qpos, qvel, ctrl, sensordata: as MuJoCo has them, [N, ·].
        layout: positions at the start of the episode and of the newest goal [N, 1 + M, 2].
        start_pose: (x, y, yaw) of the robot at the start of the episode [N, 3].
        goal_button: index of the goal button, -1 where there is none, int64 [N].
        buttons_timer: steps until the buttons wake up, int64 [N].
        step_count: steps taken in this episode, int64 [N].
    """

    scene: Scene
    physics: Physics
    robot_pos: Tensor
    robot_mat: Tensor
    com: Tensor
    up: Tensor
    velocity: Tensor | None
    positions: Tensor
    contacts: Mapping[str, Tensor]
    vase_velocity: Tensor
    qpos: Tensor
    qvel: Tensor
    ctrl: Tensor
    sensordata: Tensor
    layout: Tensor
    start_pose: Tensor
    goal_button: Tensor
    buttons_timer: Tensor
    step_count: Tensor

    def at(self, kind: str) -> Tensor:
        """Return the positions of one kind's objects [N, K, 3], a view; K may be 0."""
        return self.positions[:, self.scene.slots.get(kind, slice(0, 0))]


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
    positions = torch.zeros(num_envs, num_objects, 3, dtype=torch.float64)
    positions[..., 2] = torch.tensor(scene.heights, dtype=torch.float64)
    velocities = physics.qvel[:, scene.robot_nv :].view(num_envs, scene.num_free, 6)[..., :3]
    oriented = model.body(scene.config.reward_orientation_body).id
    velocity = None
    if scene.config.task == "circle":
        first = model.sensor("robot_velocity").adr[0]
        velocity = physics.sensordata[:, first : first + 3]
    return World(
        scene=scene,
        physics=physics,
        robot_pos=physics.xpos[:, robot],
        robot_mat=physics.xmat[:, robot],
        com=physics.subtree_com[:, robot],
        up=physics.xmat[:, oriented, 2, 2],
        velocity=velocity,
        positions=positions,
        contacts={kind: physics.sensordata[:, cols] for kind, cols in scene.contacts.items()},
        vase_velocity=velocities[:, scene.slots.get("vases", slice(0, 0))],
        qpos=physics.qpos,
        qvel=physics.qvel,
        ctrl=physics.ctrl,
        sensordata=physics.sensordata,
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
    centres: Tensor, time: Tensor, travel: float, height: float, timestep: float, num_substeps: int
) -> Tensor:
    """Positions of the gremlins' targets before each substep (circles of radius `travel`).

    Args:
        centres: where the gremlins were placed [N, K, 2].
        time: simulation time before the first substep [N].
        travel: radius of the circle [m].
        height: z of the targets [m].
        timestep: length of a substep [s].
        num_substeps: S.

    Returns:
        [N, S, K, 3]; at time 0 a target stands at +travel along y.
    """
    steps = torch.arange(num_substeps, dtype=time.dtype)
    phase = (time.unsqueeze(-1) + timestep * steps)[..., None]
    offset = travel * torch.stack([torch.sin(phase), torch.cos(phase)], -1)
    targets = centres.unsqueeze(1) + offset
    return torch.cat([targets, torch.full_like(targets[..., :1], height)], -1)
