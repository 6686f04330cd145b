"""State of the worlds: named views, poses, and reading and writing it for resuming and tests."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from safe_rl.envs.physics import Physics
from safe_rl.envs.safety_gym.tasks import TASKS, goal_is_button
from safe_rl.envs.safety_gym.world import NO_BUTTON, Scene, World


def make_world(scene: Scene, physics: Physics) -> World:
    """Bind the views of a scene to the tensors of a physics backend."""
    num_envs, num_objects = physics.qpos.shape[0], len(scene.names)
    real: dict[str, Any] = {"dtype": physics.dtype, "device": physics.device}
    whole: dict[str, Any] = {"dtype": torch.int64, "device": physics.device}
    robot, model = scene.robot_body, scene.model
    # In memory all x are first, then all y, then all z, so that each coordinate is contiguous.
    positions = torch.zeros(3, num_envs, num_objects, **real).movedim(0, -1)
    positions[..., 2] = torch.tensor(scene.heights, **real)
    velocities = physics.qvel[:, scene.robot_nv :].view(num_envs, scene.num_free, 6)[..., :3]
    robot_pos = physics.xpos[:, robot]
    velocity = int(model.sensor("robot_vel").adr[0])
    yaws = torch.full((1 + scene.num_free,), math.nan, dtype=torch.float64)
    if scene.config.robot_rot is not None:
        yaws[0] = scene.config.robot_rot
    for kind, span in scene.slots.items():
        if span.stop <= scene.num_free:
            given = getattr(scene.config, f"{kind}_rots", ())[: span.stop - span.start]
            yaws[1 + span.start : 1 + span.start + len(given)] = yaws.new_tensor(given)
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
        target_travel=torch.tensor(scene.travel, **real),
        # The targets of guided objects are at twice the height of the objects' centres.
        target_height=2 * positions[0, scene.guided, 2],
        pinned_yaws=yaws.to(physics.device),
        layout=torch.zeros(num_envs, 1 + num_objects, 2, **real),
        start_pose=torch.zeros(num_envs, 3, **real),
        goal_button=torch.full((num_envs,), NO_BUTTON, **whole),
        buttons_timer=torch.zeros(num_envs, **whole),
        step_count=torch.zeros(num_envs, **whole),
    )


def refresh(world: World) -> None:
    """Copy the positions of the free bodies from the physics."""
    scene = world.scene
    if scene.num_free:
        world.positions[:, : scene.num_free] = world.physics.xpos[:, scene.free_bodies]


def put(target: Tensor, mask: Tensor, values: Tensor) -> None:
    """Write values [N, ...] to a tensor [N, ...] in the rows of a mask [N]."""
    target.copy_(torch.where(mask.view(-1, *[1] * (target.ndim - 1)), values, target))


def yaw_quaternion(yaw: Tensor) -> Tensor:
    """Convert rotations about z by yaw [...] to quaternions (w, x, y, z) [..., 4]."""
    zero = torch.zeros_like(yaw)
    return torch.stack([torch.cos(yaw / 2), zero, zero, torch.sin(yaw / 2)], -1)


def gremlin_path(world: World, time: Tensor, num_substeps: int) -> Tensor:
    """Return the mocap positions before each of S substeps [N, S, nmocap, 3].

    The gremlins' targets move in circles, from +y at time 0; `time` is that of the first substep
    [N] (s).
    """
    scene, physics = world.scene, world.physics
    steps = torch.arange(num_substeps, dtype=time.dtype, device=time.device)
    phase = (time.unsqueeze(-1) + physics.timestep * steps)[..., None]
    circle = torch.stack([torch.sin(phase), torch.cos(phase)], -1)
    centres = world.layout[:, 1 + scene.guided.start : 1 + scene.guided.stop]
    xy = centres.unsqueeze(1) + world.target_travel.unsqueeze(-1) * circle
    z = world.target_height.expand(xy.shape[:-1]).unsqueeze(-1)
    static = physics.mocap_pos[:, None, scene.num_targets :].expand(-1, num_substeps, -1, -1)
    return torch.cat([torch.cat([xy, z], -1), static], 2)


def place_mocaps(world: World) -> None:
    """Write the positions of static bodies and of the gremlins' targets into the state."""
    scene, physics = world.scene, world.physics
    if scene.num_mocap_slots:
        span = slice(scene.num_free, scene.num_free + scene.num_mocap_slots)
        physics.mocap_pos[:, scene.num_targets :] = world.positions[:, span]
    if scene.num_targets:
        # The state was computed with the positions that the targets had in the last substep, which
        # began one timestep ago. At the start they are at the positions of their objects.
        last = (physics.time - physics.timestep).clamp(min=0.0)
        targets = gremlin_path(world, last, 1)[:, 0, : scene.num_targets]
        centres = world.layout[:, 1 + scene.guided.start : 1 + scene.guided.stop]
        height = (0.5 * world.target_height).expand(len(centres), -1)
        started = (physics.time > 0.0).view(-1, 1, 1)
        at_start = torch.cat([centres, height.unsqueeze(-1)], -1)
        physics.mocap_pos[:, : scene.num_targets] = torch.where(started, targets, at_start)


def point_goal_at_button(world: World, mask: Tensor) -> None:
    """Set the goal's position to that of the goal button in the worlds of a mask."""
    number = world.goal_button.clamp(min=0).view(-1, 1, 1).expand(-1, 1, 3)
    button = world.at("buttons").gather(1, number)[:, 0]
    put(world.positions[:, world.scene.slots["goal"].start], mask, button)


PHYSICS_KEYS = ("qpos", "qvel", "qacc_warmstart", "time")
TASK_KEYS = ("goal_button", "buttons_timer", "step_count")
LAYOUT_KEYS = ("layout", "start_pose")
SEED_KEYS = ("fixed_layout", "seed", "episode")  # of the environment, not of its worlds
# Without the last control, sensors that depend on actuators differ until the next step.
OPTIONAL_KEYS = (*LAYOUT_KEYS, *SEED_KEYS, "target_quat", "ctrl", "act", "history")


def stored_tensors(world: World) -> dict[str, Tensor]:
    """Return the tensors that a state contains unchanged, by key."""
    return {
        **{key: getattr(world.physics, key) for key in (*PHYSICS_KEYS, "ctrl")},
        **{key: getattr(world, key) for key in (*TASK_KEYS, *LAYOUT_KEYS)},
        **world.physics.memory,
    }


def write_state(world: World, state: TensorDictBase) -> None:
    """Set N worlds to a state that fits them, and compute all outputs."""
    scene, physics = world.scene, world.physics
    target_quat = state.get("target_quat", physics.mocap_quat[:, : scene.num_targets].clone())
    everywhere = torch.ones_like(world.step_count, dtype=torch.bool)
    physics.reset(everywhere)
    for key, tensor in stored_tensors(world).items():
        if key in state:
            tensor.copy_(state[key])
    physics.mocap_quat[:, : scene.num_targets] = target_quat
    world.positions[:, scene.num_free :, :2] = world.layout[:, 1 + scene.num_free :]
    if goal_is_button(scene.config.task):
        point_goal_at_button(world, everywhere)
    elif "goal" in scene.slots:
        goal = scene.slots["goal"].start
        world.positions[:, goal] = state["goal_pos"]
        world.layout[:, 1 + goal] = state["goal_pos"][:, :2]
    place_mocaps(world)
    physics.forward()
    refresh(world)
