"""Tasks: measurements, rewards, and when a goal is met (paper section 4.1.2).

Dense rewards are differences of measurements between two steps. The environment stores the earlier
measurement, and measures again when a new goal is drawn. So a change of goal does not change the
reward.

Commands that only compose a configuration also import this table and must start quickly. So torch
is imported inside the functions that need more than methods of tensors.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.safety_gym.config import SafetyGymConfig

if TYPE_CHECKING:
    from torch import Tensor

    from safe_rl.envs.safety_gym.world import World


_CENTRE = 1e-12  # smallest radius, against a division by 0 [m]


def circle_speed(com_xy: Tensor, velocity_xy: Tensor, radius: float) -> Tensor:
    """Return the speed [N] about the origin, reduced by the distance to the circle [m]."""
    (x, y), (u, v) = com_xy.unbind(-1), velocity_xy.unbind(-1)
    r = (x**2 + y**2).sqrt()
    # in the centre, where a robot may start, the numerator is 0
    return ((-u * y + v * x) / r.clamp_min(_CENTRE)) / (1 + (r - radius).abs())


class Task(NamedTuple):
    """A row: one task.

    Attributes:
        reward: (config, world, measured one step before [N, D], measured now [N, D]) -> [N].
        measure: Measurements whose differences are the reward, world -> [N, D].
        met: (config, world, measured now) -> bool [N], for tasks with goals.
        goal_at_button: Whether a new goal is one of the buttons; otherwise it is a position.
        elements: Kinds of which the task adds one object each.
        touches: Kinds of objects whose contacts with the robot it reads.
        at_origin: Kinds without an object that are observed at the origin.
    """

    reward: Callable[[SafetyGymConfig, World, Tensor, Tensor], Tensor]
    measure: Callable[[World], Tensor] = lambda w: w.robot_pos.new_zeros(len(w.robot_pos), 0)
    met: Callable[[SafetyGymConfig, World, Tensor], Tensor] | None = None
    goal_at_button: bool = False
    elements: tuple[str, ...] = ()
    touches: tuple[str, ...] = ()
    at_origin: tuple[str, ...] = ()


def goal_distance(world: World) -> Tensor:
    """Distance [N, 1] of the robot from the goal on the floor [m]."""
    import torch

    return torch.linalg.vector_norm(world.robot_xy.unsqueeze(1) - world.at("goal")[..., :2], dim=-1)


def _approach(config: SafetyGymConfig, world: World, before: Tensor, now: Tensor) -> Tensor:
    return config.reward_distance * (before - now)[:, 0]


def _in_goal(config: SafetyGymConfig, world: World, now: Tensor) -> Tensor:
    return now[:, 0] <= config.goal_size


def _presses_goal(config: SafetyGymConfig, world: World, now: Tensor) -> Tensor:
    contacts = world.contacts_with("buttons")
    return contacts.gather(1, world.goal_button.unsqueeze(1))[:, 0] > 0


def _to_box_and_goal(world: World) -> Tensor:
    import torch

    box = world.at("box")
    apart = torch.cat([world.robot_pos[:, None] - box, box - world.at("goal")], 1)
    return torch.linalg.vector_norm(apart, dim=-1)


def _push(config: SafetyGymConfig, world: World, before: Tensor, now: Tensor) -> Tensor:
    gained = before - now
    far = before[:, 0] > config.box_null_dist * config.box_size
    to_box = (config.reward_box_dist * gained[:, 0]).where(far, 0.0)
    return to_box + config.reward_box_goal * gained[:, 1]


def _box_in_goal(config: SafetyGymConfig, world: World, now: Tensor) -> Tensor:
    return now[:, 1] <= config.goal_size


TASKS: dict[str, Task] = {
    "goal": Task(_approach, goal_distance, _in_goal, elements=("goal",)),
    "button": Task(_approach, goal_distance, _presses_goal, True, ("goal",), touches=("buttons",)),
    "push": Task(_push, _to_box_and_goal, _box_in_goal, elements=("goal", "box")),
    "x": Task(lambda c, w, before, now: c.reward_x * (now - before)[:, 0], lambda w: w.com),
    "z": Task(lambda c, w, before, now: c.reward_z * (now - before)[:, 2], lambda w: w.com),
    "circle": Task(
        lambda c, w, before, now: (
            c.reward_circle * circle_speed(w.com[:, :2], w.robot_vel[:, :2], c.circle_radius)
        ),
        elements=("circle",),
        at_origin=("goal",),
    ),
    "none": Task(
        lambda c, w, before, now: w.robot_pos.new_zeros(len(w.robot_pos)), at_origin=("goal",)
    ),
}


BUILT_IN_TASKS = frozenset(TASKS)


def dense_reward(task: Task, world: World, before: Tensor, now: Tensor, failed: Tensor) -> Tensor:
    """Return the reward [N] without the bonus for a goal, clipped to ±`reward_clip`.

    Raises:
        ConfigError: If a registered task's reward has a wrong shape or is not finite.
    """
    config = world.scene.config
    reward = world.require(
        f"'reward' of task '{config.task}'", task.reward(config, world, before, now)
    )
    if config.task not in BUILT_IN_TASKS:
        error = ConfigError(
            f"'reward' of task '{config.task}' is NaN or infinite: return a number for every world."
        )
        world.physics.check(~(reward.isfinite() | failed), lambda: error)
    if config.reward_orientation:
        reward = reward + config.reward_orientation_scale * world.up
    if config.reward_clip:
        reward = reward.clamp(-config.reward_clip, config.reward_clip)
    return reward
