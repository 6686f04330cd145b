"""Binding the views of a scene to the physics.

The views are made once. They share memory with the physics, so they are always current, and no
step pays for building them.
"""

from __future__ import annotations

import torch

from safe_rl.envs.physics.batch import BatchPhysics
from safe_rl.envs.safety_gym.records.scene import Scene
from safe_rl.envs.safety_gym.records.world import NO_BUTTON, World
from safe_rl.envs.safety_gym.rules.tasks import TASKS


def make_world(scene: Scene, physics: BatchPhysics) -> World:
    """Bind the views of a scene to the tensors of a physics backend."""
    num_envs, num_objects = physics.qpos.shape[0], len(scene.names)
    robot, model = scene.robot_body, scene.model
    # In memory all x, then all y, then all z: passes over one coordinate are over one piece.
    positions = torch.zeros(3, num_envs, num_objects, dtype=torch.float64).movedim(0, -1)
    positions[..., 2] = torch.tensor(scene.heights, dtype=torch.float64)
    velocities = physics.qvel[:, scene.robot_nv :].view(num_envs, scene.num_free, 6)[..., :3]
    robot_pos = physics.xpos[:, robot]
    velocity = int(model.sensor("robot_vel").adr[0])
    return World(
        scene=scene,
        physics=physics,
        robot_pos=robot_pos,
        robot_xy=physics.xpos[:, robot, :2],
        robot_mat=physics.xmat[:, robot],
        com=physics.subtree_com[:, robot],
        up=physics.xmat[:, scene.oriented_body, 2, 2],
        robot_vel=physics.sensordata[:, velocity : velocity + 3],
        positions=positions,
        objects={kind: positions[:, span] for kind, span in scene.slots.items()}
        | dict.fromkeys(TASKS[scene.config.task].at_origin, torch.zeros_like(robot_pos[:, None])),
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
