"""States in which something happens, how they are reached, and runs to be compared."""

import math

import numpy as np
import torch
from tensordict import TensorDict

from safe_rl.envs import SafetyGymEnv

FREE = ("vase", "gremlin", "box")


def make(config, num_envs: int = 1, seed: int = 0, sleep: bool = False) -> SafetyGymEnv:
    """Worlds whose first episodes have begun, and in which nothing sleeps."""
    env = SafetyGymEnv(config, num_envs=num_envs, seed=seed, sleep=sleep, num_threads=1)
    env.reset()
    return env


def kind_of(name: str) -> str:
    """Kind of an object by its name: `vase3` is a `vase`."""
    return name.rstrip("0123456789")


def position_columns(env) -> dict[str, slice]:
    """Columns of `qpos` with the (x, y) of the robot and of every free object."""
    free = [name for name in env.object_names if kind_of(name) in FREE]
    first = env.get_state()["qpos"].shape[-1] - 7 * len(free)
    columns = {name: slice(first + 7 * i, first + 7 * i + 2) for i, name in enumerate(free)}
    return {"robot": slice(0, 2), **columns}


def places(env, state: TensorDict) -> dict[str, torch.Tensor]:
    """Where the robot and every object is [N, 2], by name."""
    names = ("robot", *env.object_names)
    found = {name: state["layout"][:, i] for i, name in enumerate(names)}
    found |= {name: state["qpos"][:, span] for name, span in position_columns(env).items()}
    if "goal" in found:
        found["goal"] = state["goal_pos"][:, :2]
    return found


def arrange(env, **poses: tuple[float, ...]) -> TensorDict:
    """The present state with the robot and objects put at (x, y) or (x, y, yaw), at rest.

    Objects that are not named stay where they are.
    """
    state, columns = env.get_state(), position_columns(env)
    state["qvel"].zero_()
    planar = env.config.robot_base == "point"
    for name, (x, y, *yaw) in poses.items():
        where = torch.tensor([x, y], dtype=torch.float64)
        state["layout"][:, ("robot", *env.object_names).index(name)] = where
        if name == "goal":
            state["goal_pos"][:, :2] = where
        if name in columns:
            state["qpos"][:, columns[name]] = where
        if not yaw:
            continue
        if name == "robot" and planar:
            state["qpos"][:, 2] = yaw[0]
        else:
            quat = [math.cos(yaw[0] / 2), 0.0, 0.0, math.sin(yaw[0] / 2)]
            first = columns[name].start + 3
            state["qpos"][:, first : first + 4] = torch.tensor(quat, dtype=torch.float64)
    return state


def step_from(env, state: TensorDict, *controls: float) -> TensorDict:
    """What a step from a state returns, with the same action in every row."""
    action = torch.tensor(controls, dtype=torch.float32).expand(env.action_spec.shape)
    return env.step(env.set_state(state).set("action", action.clone()))["next"]


def observe(env, **poses: tuple[float, ...]) -> dict[str, np.ndarray]:
    """Every component of the first world's observation of an arrangement."""
    flat = env.set_state(arrange(env, **poses))["observation"][0].double().numpy()
    return {name: flat[columns] for name, columns in env.observation_layout.items()}


def play(env, start: TensorDict, num_steps: int) -> TensorDict:
    """All outputs of a run with resets [N, T]; row k gets the same actions whatever N is."""
    num_envs, size = env.action_spec.shape
    rows = [
        2 * torch.rand(num_steps, size, generator=torch.Generator().manual_seed(row)) - 1
        for row in range(num_envs)
    ]
    steps, tensordict = [], start
    for action in torch.stack(rows, 1) * env.action_spec.space.high[0]:
        following, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
        steps.append(following["next"].clone())
    return torch.stack(steps, 1)


def assert_same(a: TensorDict, b: TensorDict) -> None:
    assert set(a.keys(True, True)) == set(b.keys(True, True))
    for key, value in a.items(True, True):
        assert torch.equal(value, b[key]), key
