"""Folders of new runs, and a run's own copy of a custom robot.

A run is continued with the robot that it began with. The configuration still names the user's file,
by which runs are told apart; where that is gone or has changed, the run's copy takes its place.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from safe_rl import envs
from safe_rl.cli.grammar import CommandLineError
from safe_rl.envs import ConfigError
from safe_rl.envs.safety_gym.robots import copy_robot, fingerprint, is_robot, own_robot
from safe_rl.files import replace_text
from safe_rl.runs.folder import RunFolder

__all__ = [
    *("check_writable", "keep_robot", "maker_of", "missing_folders", "new_folder"),
    *("remove_folders", "robot_of"),
]


def new_folder(hydra: DictConfig) -> tuple[Path, list[Path]]:
    """The folder of a new run, and which folders were missing before.

    It is made, so that it is nobody else's. Where the name is taken, by a run that began in the
    same second say, it gets a number. A folder that the command line names is left as it is.

    Args:
        hydra: Hydra's own configuration.

    Raises:
        CommandLineError: If nothing can be written there.
    """
    wanted = Path(os.path.abspath(Path(hydra.run.dir).expanduser()))
    check_writable(wanted, "hydra.run.dir")
    missing = missing_folders(wanted)
    if any(text.lstrip("+").startswith("hydra.run.dir=") for text in hydra.overrides.hydra):
        return wanted, missing
    for number in count(1):
        path = wanted if number == 1 else wanted.with_name(f"{wanted.name}_{number}")
        with suppress(FileExistsError):
            path.mkdir(parents=True)
            break
    return path, [path, *missing[1:]]


def missing_folders(folder: Path) -> list[Path]:
    """A folder and those above it, as far as they are not there."""
    place = Path(os.path.abspath(folder))
    return [path for path in (place, *place.parents) if not path.exists()]


def check_writable(folder: Path, key: str) -> None:
    """Refuse a folder in which nothing can be written, before it is made.

    Args:
        folder: The folder.
        key: What names it, for the message.

    Raises:
        CommandLineError: If so.
    """
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise CommandLineError(
            f"{key}={folder}: nothing can be written there: {error.strerror}."
        ) from None


def remove_folders(missing: Sequence[Path]) -> None:
    """Remove the folder of a run that could not begin, and those above it that are empty."""
    for path in missing[:1]:
        shutil.rmtree(path, ignore_errors=True)
    for path in missing[1:]:
        try:
            path.rmdir()
        except OSError:  # other runs have come into it
            return


def keep_robot(folder: RunFolder, env: Mapping[str, Any]) -> None:
    """Note which robot a run begins with, and copy its files; bundled robots need none.

    Where they cannot be copied the hash is kept, and the reason is printed.

    Args:
        folder: The run's.
        env: Node of its environment.

    Raises:
        OSError: If nothing can be written.
    """
    robot = _own_robot(env)
    if robot is None:
        return
    shutil.rmtree(folder.robot, ignore_errors=True)
    note = {"robot_base": env["robot_base"], "sha256": fingerprint(robot), "file": None}
    try:
        copy = copy_robot(robot, folder.robot)
        note["file"] = str(copy.relative_to(folder.robot))
    except ConfigError as error:
        shutil.rmtree(folder.robot, ignore_errors=True)
        print(f"{error} The run keeps no copy of its robot: it needs that file as it is now.")
    except OSError:
        shutil.rmtree(folder.robot, ignore_errors=True)
        raise
    replace_text(folder.robot_note, json.dumps(note, indent=1) + "\n")


def robot_of(folder: RunFolder, env: Mapping[str, Any]) -> tuple[dict[str, Any], str | None]:
    """Find the robot that a run began with.

    Args:
        folder: The run's, which may not have begun.
        env: Node of an environment; one with another robot than the run's stays as it is.

    Returns:
        The node with a file of that robot, and what to say where it is the run's copy.

    Raises:
        ConfigError: If there is no file of it any more.
    """
    note = _read_note(folder)
    if not note or note.get("robot_base") != env.get("robot_base"):
        return dict(env), None
    original, content = _own_robot(env), str(note.get("sha256"))
    if original is not None and original.is_file():
        if fingerprint(original) == content:
            return dict(env), None
        reason = f"{original} has changed since the run began"
    else:
        reason = f"there is no file {str(env['robot_base'])!r}"
    copy = folder.robot / str(note.get("file"))
    if not (note.get("file") and copy.is_file()):
        raise ConfigError(f"'robot_base': {reason}, and {folder.directory} has no copy of it.")
    if not is_robot(copy, folder.robot, content):
        raise ConfigError(f"'robot_base': {reason}, and so has the run's own copy, {copy}.")
    return {**env, "robot_base": str(copy)}, f"'robot_base': {reason}: using the run's copy, {copy}"


def maker_of(directory: Path) -> Callable[..., envs.ConstrainedEnv]:
    """:func:`safe_rl.envs.make_env` for environments of a run, with the robot that it began with.

    Where that is the run's own copy, it says so once.
    """
    said: set[str | None] = {None}

    def make(env: Mapping[str, Any], **options: Any) -> envs.ConstrainedEnv:
        node, notice = robot_of(RunFolder(directory), env)
        if notice not in said:
            said.add(notice)
            print(notice)
        return envs.make_env(node, **options)

    return make


def _own_robot(env: Mapping[str, Any]) -> Path | None:
    """A robot file of the user's; environments of other families have none."""
    return own_robot(env) if env.get("_target_") is None and "robot_base" in env else None


def _read_note(folder: RunFolder) -> dict[str, Any]:
    if not os.path.isfile(folder.robot_note):  # nor is it in a folder that cannot be
        return {}
    try:
        note = json.loads(folder.robot_note.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"'robot_base': {folder.robot_note} cannot be read: {error}") from None
    return note if isinstance(note, dict) else {}
