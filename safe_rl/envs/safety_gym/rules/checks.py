"""Checks of a whole configuration: names that rules give, and what keys need of one another.

Types and ranges of single values are the record's own business, see `records.values`.
"""

from __future__ import annotations

from pathlib import Path

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.records.values import LARGEST_SEED, check_choice
from safe_rl.envs.safety_gym.rules.robots import PATHS_OF_2019, ROBOTS
from safe_rl.envs.safety_gym.rules.tasks import TASKS, goal_is_button


def check(config: SafetyGymConfig) -> SafetyGymConfig:
    """Return a configuration that an environment can be made of.

    Raises:
        ConfigError: naming the first key that is wrong.
    """
    check_choice("task", config.task, TASKS)
    name = PATHS_OF_2019.get(config.robot_base)
    if name is not None and not Path(config.robot_base).is_file():
        config = config.replace(robot_base=name)
    _check_robot(config.robot_base)
    if config.layout_seeds_first + (config.layout_seeds or 0) > LARGEST_SEED:
        raise ConfigError(
            f"'layout_seeds_first' and 'layout_seeds' together must be at most {LARGEST_SEED}, got "
            f"{config.layout_seeds_first} and {config.layout_seeds}."
        )
    if goal_is_button(config.task) and config.buttons_num < 1:
        raise ConfigError(f"'task' {config.task} needs at least one button: set 'buttons_num'.")
    if config.constrain_boundary and config.boundary_x is None and config.boundary_y is None:
        raise ConfigError("'constrain_boundary' needs 'boundary_x', 'boundary_y' or both [m].")
    if config.constrain_velocity and config.velocity_limit is None:
        raise ConfigError("'constrain_velocity' needs 'velocity_limit' [m/s].")
    return config


def _check_robot(robot: str) -> None:
    if robot.endswith(".xml"):
        if not Path(robot).is_file():
            raise ConfigError(f"'robot_base': there is no file {robot!r}.")
    elif robot not in ROBOTS:
        raise ConfigError(
            f"'robot_base' must be one of {tuple(ROBOTS)} or the path of an MJCF (.xml) file, "
            f"got {robot!r}.{nearest(robot, ROBOTS)}"
        )
