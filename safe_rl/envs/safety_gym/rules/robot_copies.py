"""Copies of robots of one's own, by which they are found when their files are gone."""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gym.rules.robot_files import fingerprint, robot_files
from safe_rl.envs.safety_gym.rules.robots import BUNDLED, PATHS_OF_2019, load_robot, robot_path

MOST_BYTES = 1 << 28  # of one robot's files


def own_robot(keys: Mapping[str, Any]) -> Path | None:
    """Return the file of the robot that an environment's keys name, if it is none of the bundled.

    Examples:
        >>> own_robot({"robot_base": "mine.xml"})
        PosixPath('mine.xml')
        >>> own_robot({"robot_base": "doggo"})
    """
    base = str(keys.get("robot_base", "car"))
    path = robot_path(base)
    is_bundled = path.parent == BUNDLED or (base in PATHS_OF_2019 and not path.is_file())
    return None if is_bundled else path


def copy_robot(path: Path, folder: Path) -> Path:
    """Copy a robot's file and all files that it names; they stay where they are to each other.

    Args:
        path: its MJCF file.
        folder: where to, made if it is not there.

    Returns:
        The MJCF file of the copy.

    Raises:
        ConfigError: if the copy is another robot, or none, because it finds its files by absolute
            paths for instance; or if the files are too large.
        OSError: if they cannot be copied.
    """
    files = [_absolute(file) for file in robot_files(path)]
    size = sum(file.stat().st_size for file in files)
    if size > MOST_BYTES:
        raise ConfigError(f"'robot_base': the files of {path} have {size / 1e6:,.0f} MB.")
    home = Path(os.path.commonpath([file.parent for file in files]))
    for file in files:
        copy = folder / file.relative_to(home)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
    copy = folder / _absolute(path).relative_to(home)
    if not is_robot(copy, folder, fingerprint(path)):
        raise ConfigError(f"'robot_base': {path} names files by absolute paths.")
    load_robot(str(copy))
    return copy


def is_robot(path: Path, folder: Path, content: str) -> bool:
    """Whether a robot's files have a fingerprint, and all of them are in a folder.

    Raises:
        ConfigError: if one cannot be read.
    """
    inside = folder.resolve()
    return fingerprint(path) == content and all(
        file.resolve().is_relative_to(inside) for file in robot_files(path)
    )


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))  # links stay what they are
