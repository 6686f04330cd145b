"""Random draws: the start of an episode, new goals, noise and frame skip.

The key of every draw is made of the row's seed, the episode, the step and its purpose, see `rng`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum

import torch
from torch import Tensor

from safe_rl.envs import rng
from safe_rl.envs.physics import Physics
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.layouts import (
    LayoutError,
    PlacementPlan,
    resample_goal,
    sample_layouts,
)
from safe_rl.envs.safety_gym.state import (
    place_mocaps,
    point_goal_at_button,
    put,
    refresh,
    yaw_quaternion,
)
from safe_rl.envs.safety_gym.tasks import goal_is_button
from safe_rl.envs.safety_gym.world import World


class Purpose(IntEnum):
    """The purpose of a random draw, which is a part of its key."""

    LAYOUT = 0
    YAW = 1
    BUTTON = 2
    GOAL = 3
    NOISE = 4
    FRAMESKIP = 5
    SPLIT = 6
    FIRST_GOAL = -1  # differs from all step numbers, which are in the same place of a key


def pick_layouts(config: SafetyGymConfig, key: Tensor) -> Tensor:
    """Pick layouts uniformly from the finite set of `layout_seeds`: keys [N] -> layout keys [N].

    A layout key depends only on the picked layout seed. So environments with other seeds, and
    evaluations on the same set, have the same layouts.
    """
    assert config.layout_seeds is not None
    index = (rng.uniform(key, Purpose.SPLIT) * config.layout_seeds).to(torch.int64)
    return rng.fold(config.layout_seeds_first + index, Purpose.SPLIT)


def draw_layouts(plan: PlacementPlan, physics: Physics, key: Tensor) -> Tensor:
    """Draw the positions of robot and objects for episodes with keys [B]: [B, 1 + M, 2].

    Raises:
        LayoutError: If there is no layout; the message names the object that did not fit.
    """
    layouts = sample_layouts(plan, rng.fold(key, Purpose.LAYOUT))
    if "goal" in plan.names:
        # As in the benchmark, the first goal is drawn again after all objects are placed, so it is
        # a second draw. Where no place is found, the first draw remains.
        position, found = resample_goal(plan, physics, rng.fold(key, Purpose.FIRST_GOAL), layouts)
        put(layouts[:, plan.goal_column], found, position)
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
    if goal_is_button(scene.config.task):
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
    if goal_is_button(config.task):
        _choose_button(world, rng.fold(key, Purpose.BUTTON), mask)
        return torch.zeros_like(mask)
    goal_key, column = rng.fold(key, Purpose.GOAL), plan.goal_column
    position, found = resample_goal(plan, physics, goal_key, _current(world), mask)
    put(world.positions[:, column - 1, :2], found, position)
    put(world.layout[:, column], found, position)
    stuck = mask & ~found
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


class LayoutsAhead:
    """Layouts by their keys, drawn in advance and stored until they are needed.

    A layout depends only on its key, and to draw one layout takes about as long as to draw a
    hundred. So when a row begins an episode, the next layouts of the other rows are drawn too. They
    need not be part of a saved state.

    Args:
        draw: Draws the layouts of keys, int64 [B] -> [B, 1 + M, 2]; raises `LayoutError` if there
            is none for one of the keys.
        num_envs: Number of rows, N.
        num_columns: 1 + M.
        device: Device of the keys.
    """

    def __init__(
        self,
        draw: Callable[[Tensor], Tensor],
        num_envs: int,
        num_columns: int,
        device: torch.device | None = None,
    ) -> None:
        self._draw = draw
        self._known = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._keys = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._layouts = torch.zeros(num_envs, num_columns, 2, dtype=torch.float64, device=device)

    def __call__(self, key: Tensor, following: Tensor, mask: Tensor) -> Tensor:
        """Return layouts [N, 1 + M, 2] that are valid in the rows of a mask.

        Args:
            key: Keys of the layouts of the present episodes, int64 [N].
            following: Keys of the layouts of the next episodes, int64 [N].
            mask: Rows that begin an episode, bool [N].

        Raises:
            LayoutError: If there is no layout; the message names the object that did not fit.
        """
        if (((self._keys != key) | ~self._known) & mask).any():
            wanted = torch.where(mask, key, following)
            rows = (self._keys != wanted) | ~self._known
            try:
                drawn = self._draw(wanted[rows])
            except LayoutError:
                # The missing layout may be that of a next episode, which perhaps never begins.
                rows &= mask
                drawn = self._draw(wanted[rows])
            self._layouts[rows], self._keys[rows], self._known[rows] = drawn, wanted[rows], True
        return self._layouts
