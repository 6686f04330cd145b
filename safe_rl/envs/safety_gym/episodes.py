"""State of N worlds: named views, the start of an episode, new goals, and what a state stores.

The key of every random draw is made of the row's seed, the episode, the step and its purpose, see
`rng`.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any

import torch
from torch import Tensor

from safe_rl.envs import rng
from safe_rl.envs.physics import RESTORED, Physics, put
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.layouts import (
    LayoutError,
    PlacementPlan,
    resample_goal,
    sample_layouts,
)
from safe_rl.envs.safety_gym.tasks import TASKS
from safe_rl.envs.safety_gym.world import NO_BUTTON, Scene, World


class Purpose(IntEnum):
    """The purpose of a random draw, which is a part of its key."""

    LAYOUT = 0
    YAW = 1
    BUTTON = 2
    GOAL = 3
    NOISE = 4
    FRAMESKIP = 5
    LAYOUT_SEED = 6
    FIRST_GOAL = -1  # differs from all step numbers, which are in the same place of a key


TASK_KEYS = ("goal_button", "buttons_timer", "step_count")
LAYOUT_KEYS = ("layout", "start_pose")


def stored_tensors(world: World) -> dict[str, Tensor]:
    """Return the tensors that a state contains unchanged, by key."""
    return {
        **{key: getattr(world.physics, key) for key in (*RESTORED, "ctrl")},
        **{key: getattr(world, key) for key in (*TASK_KEYS, *LAYOUT_KEYS)},
        **world.physics.actuator_state,
    }


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
    outputs = physics.outputs
    robot_pos, robot_mat = outputs["xpos"][:, robot], outputs["xmat"][:, robot]
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
        robot_xy=robot_pos[:, :2],
        robot_mat=robot_mat,
        com=outputs["subtree_com"][:, robot],
        up=outputs["xmat"][:, scene.oriented_body, 2, 2],
        robot_vel=outputs["sensordata"][:, velocity : velocity + 3],
        positions=positions,
        objects={kind: positions[:, span] for kind, span in scene.slots.items()}
        | dict.fromkeys(TASKS[scene.config.task].at_origin, torch.zeros_like(robot_pos[:, None])),
        velocities=velocities,
        contacts={kind: outputs["sensordata"][:, cols] for kind, cols in scene.contacts.items()},
        qpos=physics.qpos,
        qvel=physics.qvel,
        ctrl=physics.ctrl,
        sensordata=outputs["sensordata"],
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
        world.positions[:, : scene.num_free] = world.physics.outputs["xpos"][:, scene.free_bodies]


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


def draw_layouts(plan: PlacementPlan, physics: Physics, key: Tensor) -> Tensor:
    """Draw the positions of robot and objects for episodes with keys [B]: [B, 1 + M, 2].

    Raises:
        LayoutError: If there is no layout; the message names the object that did not fit.
    """
    layouts = sample_layouts(plan, rng.fold(key, Purpose.LAYOUT))
    if "goal" in plan.names:
        # As in the benchmark, the first goal is drawn again after all objects are placed, so it is
        # a second draw. Where no place is found, the first draw remains.
        everywhere, key = torch.ones_like(key, dtype=torch.bool), rng.fold(key, Purpose.FIRST_GOAL)
        position, is_placed = resample_goal(plan, physics, key, layouts, everywhere)
        put(layouts[:, plan.goal_column], is_placed, position)
    return layouts


def start_episodes(world: World, layouts: Tensor, key: Tensor, mask: Tensor) -> None:
    """Set the worlds of a mask, bool [N], to the initial state of a new episode.

    Args:
        world: The worlds; outputs are updated in those of the mask.
        layouts: Positions of the robot and all objects [N, 1 + M, 2].
        key: Random key of each world's episode, int64 [N].
        mask: Worlds that begin a new episode.
    """
    scene, physics, pinned = world.scene, world.physics, world.pinned_yaws
    put(world.layout, mask, layouts)
    body = torch.arange(len(pinned), device=key.device)
    drawn = 2 * math.pi * rng.uniform(key[:, None], Purpose.YAW, body)
    yaws = torch.where(pinned.isnan(), drawn, pinned)
    physics.reset(mask)
    pose = torch.cat([world.layout[:, 0], yaws[:, :1]], -1)
    put(world.start_pose, mask, pose)
    put(physics.qpos[:, :2], mask, pose[:, :2])
    if scene.planar:
        put(physics.qpos[:, 2], mask, yaws[:, 0])
    else:
        put(physics.qpos[:, 3:7], mask, yaw_quaternion(yaws[:, 0]))
    free = physics.qpos[:, scene.robot_nq :].unflatten(1, (scene.num_free, 7))
    put(free[..., :2], mask, world.layout[:, 1 : 1 + scene.num_free])
    put(free[..., 3:], mask, yaw_quaternion(yaws[:, 1:]))
    if scene.num_targets:
        quaternion = yaw_quaternion(yaws[:, 1 + scene.guided.start : 1 + scene.guided.stop])
        put(physics.mocap_quat[:, : scene.num_targets], mask, quaternion)
    static = world.positions[:, scene.num_free :, :2]
    put(static, mask, world.layout[:, 1 + scene.num_free :])
    if TASKS[scene.config.task].goal_at_button:
        _choose_button(world, rng.fold(key, Purpose.BUTTON), mask)
    world.step_count.masked_fill_(mask, 0)
    world.buttons_timer.masked_fill_(mask, 0)
    place_mocaps(world)
    physics.forward(mask)
    refresh(world)


def _choose_button(world: World, key: Tensor, mask: Tensor) -> None:
    """Draw goal buttons uniformly in the worlds of a mask; the old one may be drawn again."""
    button = (rng.uniform(key) * world.scene.config.buttons_num).to(torch.int64)
    put(world.goal_button, mask, button)
    point_goal_at_button(world, mask)


def next_goals(world: World, plan: PlacementPlan, key: Tensor, mask: Tensor) -> Tensor:
    """Draw a new goal for the worlds of a mask; return those without a place for it, bool [N].

    Raises:
        LayoutError: If there are such worlds and `terminate_resample_failure` is False.
    """
    config, physics = world.scene.config, world.physics
    world.buttons_timer.masked_fill_(mask, config.buttons_resampling_delay)
    if TASKS[config.task].goal_at_button:
        _choose_button(world, rng.fold(key, Purpose.BUTTON), mask)
        return torch.zeros_like(mask)
    goal_key, column = rng.fold(key, Purpose.GOAL), plan.goal_column
    position, is_placed = resample_goal(plan, physics, goal_key, _current(world), mask)
    put(world.positions[:, column - 1, :2], is_placed, position)
    put(world.layout[:, column], is_placed, position)
    stuck = mask & ~is_placed
    if not config.terminate_resample_failure:
        physics.check(
            stuck,
            lambda: LayoutError(
                "No place for a new goal was found. Use fewer objects or smaller keepouts, or set "
                "'terminate_resample_failure' to end such episodes."
            ),
        )
    if world.scene.num_mocap_slots:
        place_mocaps(world)
    return stuck


def _current(world: World) -> Tensor:
    """Return present positions as a layout [N, 1 + M, 2].

    Guided objects, such as gremlins, have their positions at the start of the episode.
    """
    current = torch.cat([world.robot_pos[:, None, :2], world.positions[..., :2]], 1)
    guided = world.scene.guided
    columns = slice(1 + guided.start, 1 + guided.stop)
    current[:, columns] = world.layout[:, columns]
    return current


def control_noise(config: SafetyGymConfig, key: Tensor, num_controls: int) -> Tensor:
    """Draw the configured Gaussian noise on the controls: keys [N] -> [N, nu]."""
    columns = torch.arange(num_controls, device=key.device)
    return config.action_noise * rng.normal(key[:, None], Purpose.NOISE, columns)


def draw_substeps(config: SafetyGymConfig, key: Tensor) -> Tensor:
    """Draw numbers of substeps, Binomial(n, p): keys [N] -> int64 [N]."""
    trials = torch.arange(config.frameskip_binom_n, device=key.device)
    draws = rng.uniform(key[:, None], Purpose.FRAMESKIP, trials)
    return (draws < config.frameskip_binom_p).sum(-1)
