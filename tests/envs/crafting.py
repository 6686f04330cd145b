"""States in which something happens: the robot beside, on or in every kind of object."""

import math

import torch
from tensordict import TensorDict

FREE = ("vase", "gremlin", "box")
# How far a robot reaches from its centre, at least and at most [m].
REACH = {"point": (0.09, 0.13), "car": (0.1, 0.17), "doggo": (0.12, 0.28)}
# How far an object reaches; the robot's centre has to be over those that are flat [m].
HALF_WIDTH = {"vase": 0.1, "gremlin": 0.1, "box": 0.2, "pillar": 0.2, "button": 0.1}


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


def after_random_steps(env, num_steps: int) -> TensorDict:
    """The state after a reset and some steps of random actions."""
    tensordict = env.reset()
    for _ in range(num_steps):
        tensordict = env.step_mdp(env.step(env.rand_action(tensordict)))
    return env.get_state()


def random_direction() -> torch.Tensor:
    """A unit vector in the plane [2]."""
    bearing = 2 * math.pi * torch.rand((), dtype=torch.float64)
    return torch.stack([torch.cos(bearing), torch.sin(bearing)])


def meet(env, state: TensorDict, row: int, name: str) -> None:
    """Let the robot of one row run into an object, or the box reach its goal, in place."""
    where, direction = places(env, state)[name][row], random_direction()
    chance, speed = torch.rand(2).tolist()
    if name == "goal" and env.config.task == "push":
        box = position_columns(env)["box"]
        state["qpos"][row, box] = where - 1.5 * env.config.goal_size * chance * direction
        return
    nearest, farthest = REACH[env.config.robot_base]
    gap = HALF_WIDTH.get(kind_of(name), 0.0) + nearest + (farthest - nearest) * chance
    state["qpos"][row, :2] = where - gap * direction
    state["qvel"][row, :2] = speed * direction


def encounters(env, num_calm: int) -> TensorDict:
    """States after random steps, in which robots meet objects of one kind after another.

    Args:
        env: the environment; its number of worlds is the number of states.
        num_calm: the first so many rows are left as they came.
    """
    state = after_random_steps(env, num_steps=5)
    kinds: dict[str, list[str]] = {}
    for name in env.object_names:
        kinds.setdefault(kind_of(name), []).append(name)
    for row in range(num_calm, len(state) if kinds else 0):
        number, turn = divmod(row - num_calm, len(kinds))
        names = list(kinds.values())[turn]
        meet(env, state, row, names[number % len(names)])
    if env.config.task == "button":
        state["buttons_timer"][torch.rand(len(state)) < 0.2] = 3
    return state


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
