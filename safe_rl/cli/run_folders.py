"""Folders of new runs, and a run's own copy of a custom robot.

A run is continued and evaluated with the robot that it began with, even if the user's file, which
the configuration names, has changed.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from safe_rl import envs
from safe_rl.envs import ConfigError
from safe_rl.envs.safety_gym.robots import copy_robot, fingerprint, is_robot, own_robot
from safe_rl.files import read_json, replace_json
from safe_rl.runs.run import Run


def new_folder(hydra: DictConfig) -> tuple[Path, bool]:
    """Return the folder of a new run, and whether the folder is new as well.

    If a folder of that name exists, for example of a run that began in the same second, a number is
    added to the name. A folder that the command line names is used as it is.
    """
    wanted = Path(os.path.abspath(Path(hydra.run.dir).expanduser()))
    if any(text.lstrip("+").startswith("hydra.run.dir=") for text in hydra.overrides.hydra):
        return wanted, not wanted.exists()
    for number in count(1):
        path = wanted if number == 1 else wanted.with_name(f"{wanted.name}_{number}")
        with suppress(FileExistsError):
            path.mkdir(parents=True)
            break
    return path, True


def keep_robot(folder: Run, env: Mapping[str, Any]) -> None:
    """Note which custom robot a run begins with, and copy its files.

    If the files cannot be copied, the note has their hash only, and the reason is printed.
    """
    robot = _own_robot(env)
    if robot is None:
        return
    shutil.rmtree(folder.robot_folder, ignore_errors=True)
    note = {"robot_base": env["robot_base"], "sha256": fingerprint(robot), "file": None}
    try:
        note["file"] = str(copy_robot(robot, folder.robot_folder).relative_to(folder.robot_folder))
    except ConfigError as error:
        shutil.rmtree(folder.robot_folder, ignore_errors=True)
        print(f"{error} The run keeps no copy of its robot: it needs that file as it is now.")
    replace_json(folder.robot_file, note)


def robot_of(folder: Run, env: Mapping[str, Any]) -> dict[str, Any]:
    """Return an environment's node with the robot that a run began with.

    A node that names another robot, or a run that has not begun, changes nothing.

    Raises:
        ConfigError: If the file of the robot is gone, or has changed.
    """
    note = read_json(folder.robot_file) if os.path.isfile(folder.robot_file) else {}
    if not note or note["robot_base"] != env.get("robot_base"):
        return dict(env)
    original, content = _own_robot(env), note["sha256"]
    path = folder.robot_folder / str(note["file"]) if note["file"] else original
    if path is None or not path.is_file():
        raise ConfigError(f"'robot_base': there is no file {path}, with which the run began.")
    home = folder.robot_folder if note["file"] else Path(path.anchor or ".")
    if not is_robot(path, home, content):
        raise ConfigError(f"'robot_base': {path} has changed since the run began.")
    return {**env, "robot_base": str(path)}


def maker_of(directory: Path) -> Callable[..., envs.ConstrainedEnv]:
    """:func:`safe_rl.envs.make_env` for a run's environments, with the robot that it began with."""
    folder = Run(directory)
    return lambda env, **options: envs.make_env(robot_of(folder, env), **options)


def _own_robot(env: Mapping[str, Any]) -> Path | None:
    """The user's robot file, if any; environments of other families have none."""
    return own_robot(env) if env.get("_target_") is None and "robot_base" in env else None
