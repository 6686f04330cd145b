"""Reading and writing the state of the worlds, for exact resume, branching and tests."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from safe_rl.envs.safety_gym.records.world import World
from safe_rl.envs.safety_gym.rules.tasks import goal_is_button
from safe_rl.envs.safety_gym.world.draws import place_mocaps, point_goal_at_button
from safe_rl.envs.safety_gym.world.views import refresh
from safe_rl.envs.states import check_state

PHYSICS_KEYS = ("qpos", "qvel", "qacc_warmstart", "time")
TASK_KEYS = ("goal_button", "buttons_timer", "step_count")
LAYOUT_KEYS = ("layout", "start_pose")
# Without the last control, sensors that feel the actuators differ until the next step.
OPTIONAL_KEYS = (*LAYOUT_KEYS, "target_quat", "ctrl", "act", "history", "seed", "episode")
# What is not part of the physics, whose failures are noticed by themselves.
FINITE_KEYS = (*LAYOUT_KEYS, "goal_pos", "target_quat")


def read_state(world: World) -> TensorDict:
    """Return copies of the state of N worlds, a TensorDict [N]."""
    state = {key: getattr(world.physics, key).clone() for key in (*PHYSICS_KEYS, "ctrl")}
    state |= {key: getattr(world, key).clone() for key in (*TASK_KEYS, *LAYOUT_KEYS)}
    goal = world.at("goal")[:, 0] if "goal" in world.scene.slots else torch.zeros_like(world.com)
    state["goal_pos"] = goal.clone()
    state |= {key: memory.clone() for key, memory in world.physics.memory.items()}
    state["target_quat"] = world.physics.mocap_quat[:, : world.scene.num_targets].clone()
    return TensorDict(state, batch_size=[len(world.step_count)])


def write_state(world: World, state: TensorDictBase) -> None:
    """Set N worlds to a state and bring everything derived from it up to date.

    Args:
        world: the worlds.
        state: TensorDict [N] as `read_state` returns it, which `check_worlds` has passed; `layout`,
            `start_pose`, `target_quat` and `ctrl` may be missing, and then actuators remember
            nothing where `act` and `history` are.
    """
    scene, physics = world.scene, world.physics
    target_quat = state.get("target_quat", physics.mocap_quat[:, : scene.num_targets].clone())
    physics.reset(torch.ones_like(world.step_count, dtype=torch.bool))
    for key in PHYSICS_KEYS:
        getattr(physics, key).copy_(state[key])
    for key in (*TASK_KEYS, *LAYOUT_KEYS):
        if key in state:
            getattr(world, key).copy_(state[key])
    for key, memory in physics.memory.items():
        if key in state:
            memory.copy_(state[key])
    if "ctrl" in state:
        physics.ctrl.copy_(state["ctrl"])
    physics.mocap_quat[:, : scene.num_targets] = target_quat
    world.positions[:, scene.num_free :, :2] = world.layout[:, 1 + scene.num_free :]
    if goal_is_button(scene.config.task):
        point_goal_at_button(world, torch.arange(len(world.step_count)))
    elif "goal" in scene.slots:
        goal = scene.slots["goal"].start
        world.positions[:, goal] = state["goal_pos"]
        world.layout[:, 1 + goal] = state["goal_pos"][:, :2]
    place_mocaps(world)
    physics.forward()
    refresh(world)


def check_worlds(world: World, expected: TensorDictBase, state: TensorDictBase) -> None:
    """Check a state before it is set.

    Args:
        world: the worlds that it is for.
        expected: their present state, with seeds.
        state: what is about to be set.

    Raises:
        KeyError: if a key is missing.
        ValueError: if it does not fit, or there is no such goal button.
    """
    check_state(expected, state, OPTIONAL_KEYS, FINITE_KEYS)
    button, number = state["goal_button"], world.scene.config.buttons_num
    if goal_is_button(world.scene.config.task) and not ((button >= 0) & (button < number)).all():
        raise ValueError(f"State 'goal_button' must be between 0 and {number - 1}: {button}.")
