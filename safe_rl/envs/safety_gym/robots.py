"""Robots: load and check an MJCF file, and copy it to the folders of runs.

A robot file has a body named "robot" at the top level of its world. The body stands upright and is
placed by its root joint: a free joint, or slides along x and y and a hinge about z. The geom
defaults of the file apply to the whole world, but masses and the masks of collisions only to the
robot. An actuator without a `ctrlrange` gets [-1, 1].
"""

from __future__ import annotations

import hashlib
import math
import shutil
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.safety_gym.config import BUNDLED, PATHS_OF_2019, ROBOTS
from safe_rl.files import read_bounded


def fingerprint(path: Path) -> str:
    """Return a hash of the contents of a robot's files, which does not depend on their names."""
    contents = sorted(
        hashlib.sha256(read_bounded(file, 10**9)).hexdigest() for file in robot_files(path)
    )
    return hashlib.sha256(" ".join(contents).encode()).hexdigest()


def robot_files(path: Path) -> list[Path]:
    """Return an MJCF file and all existing files that it names, each once.

    Raises:
        ConfigError: If one cannot be read.
    """
    try:
        named = mujoco.mju_getXMLDependencies(str(path))
    except mujoco.FatalError as error:
        raise ConfigError(f"'robot_base': MuJoCo cannot load {path}: {error}") from error
    return [file for file in map(Path, named) if file.is_file()]


CONTROL_RANGE = (-1.0, 1.0)  # of actuators without a range in the file
_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
_PLANAR_JOINTS = (_SLIDE, _SLIDE, _HINGE)
_PLANAR_AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


@dataclass(frozen=True)
class Robot:
    """A robot for which a world can be built.

    Attributes:
        spec: MJCF specification of its file, to which the world is added.
        num_bodies: Number of its bodies, the first ones of the world after the world body.
        num_sensors: Number of its sensors, the first ones of the world.
        planar: Whether the root is (x, y, yaw) instead of a free joint.
    """

    spec: mujoco.MjSpec
    num_bodies: int
    num_sensors: int
    planar: bool


def load_robot(path: Path) -> Robot:
    """Load a robot from its file, and check that it can be placed, moved and stepped.

    Raises:
        ConfigError: If MuJoCo cannot load the file, or an environment cannot use the robot.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if spec.keys:
            warnings.warn(
                f"The keyframes of {path} are not used: joints begin an episode at 0, or at 'ref'.",
                stacklevel=2,
            )
        for key in list(spec.keys):
            spec.delete(key)  # a pose of the robot alone does not fit the world
        model = spec.copy().compile()
    except (ValueError, RuntimeError, MemoryError) as error:
        raise ConfigError(f"'robot_base': MuJoCo cannot load {path}: {error}") from error
    for fault in _faults(model, spec.compiler):
        raise ConfigError(f"'robot_base': {path} {fault}")
    for actuator, limited in zip(spec.actuators, model.actuator_ctrllimited, strict=True):
        if not limited:
            actuator.ctrlrange, actuator.ctrllimited = CONTROL_RANGE, True
    root = model.jnt_type[model.body_jntadr[model.body("robot").id]]
    is_planar = root != mujoco.mjtJoint.mjJNT_FREE
    return Robot(spec, model.nbody - 1, model.nsensor, is_planar)


def _faults(model: mujoco.MjModel, options: mujoco.MjsCompiler) -> Iterator[str]:
    """What makes a robot unusable; a check may rely on those before it."""
    ranges = model.actuator_ctrlrange.tolist()
    for (low, high), limited in zip(ranges, model.actuator_ctrllimited, strict=True):
        # MuJoCo treats a reversed range as no range.
        if not math.isfinite(high - low) or low > high or (limited and low == high):
            yield (
                f"has the control range [{low}, {high}]: every 'ctrlrange' must be finite, the "
                "lower bound first."
            )
    bodies = [model.body(i) for i in range(1, model.nbody)]
    if all(body.name != "robot" for body in bodies):
        roots = [body.name for body in bodies if body.parentid[0] == 0]
        yield f"has no body named 'robot': rename its root, one of {roots}."
    if outside := [model.geom(i).name for i in range(model.ngeom) if not model.geom_bodyid[i]]:
        yield (
            f"has geoms that belong to no body, {outside}: remove them. The world has a floor, and "
            "objects are given by keys."
        )
    body = model.body("robot")
    if body.parentid[0] != 0:
        parent = model.body(body.parentid[0]).name
        yield f"has its body 'robot' inside '{parent}': move it to the worldbody."
    if body.quat.tolist() != [1, 0, 0, 0]:
        yield (
            "rotates its body 'robot': a reset sets the body upright with a random yaw, so give "
            "the rotation to geoms or child bodies instead."
        )
    if model.nu == 0:
        yield "has no actuators: add one, which an action can control."
    if model.nmocap > 0:
        yield "has mocap bodies, which a robot cannot move: make them ordinary bodies."
    every_group = [0, mujoco.mjNGROUP - 1]
    is_changed = max(options.settotalmass, options.boundmass, options.boundinertia) > 0
    if is_changed or list(options.inertiagrouprange) != every_group:
        yield (
            "has a compiler option (settotalmass, boundmass, boundinertia or inertiagrouprange) "
            "that would change the masses of objects, too: give densities or masses to its geoms "
            "instead."
        )
    yield from _faults_of_root(model, body.id)


def _faults_of_root(model: mujoco.MjModel, body: int) -> Iterator[str]:
    """What is wrong unless the root is a free joint, or (slide x, slide y, hinge z)."""
    first, number = model.body_jntadr[body], model.body_jntnum[body]
    joints = slice(first, first + min(number, 3))
    types = tuple(model.jnt_type[joints])
    if first > 0:
        yield "has joints before those of 'robot': put this body first."
    if types[:1] == (mujoco.mjtJoint.mjJNT_FREE,):
        return
    if types != _PLANAR_JOINTS or model.jnt_axis[joints].tolist() != _PLANAR_AXES:
        yield (
            "cannot be placed: the body 'robot' needs a free joint, or slides along x and y and a "
            "hinge about z in this order."
        )
    if any((*model.body_pos[body, :2], *model.jnt_pos[joints, :2].flat, *model.qpos0[:3])):
        yield (
            "has its planar root away from the origin: x and y of the body 'robot' and of its "
            "joints, and their 'ref', must be 0, so that the joints are the robot's coordinates."
        )


def own_robot(node: Mapping[str, Any]) -> Path | None:
    """Return the user's robot file that a node names; other families than Safety Gym have none."""
    if node.get("_target_") is not None or "robot_base" not in node:
        return None
    base = str(node["robot_base"])
    path = ROBOTS.get(base, Path(base))
    is_bundled = path.parent == BUNDLED or (base in PATHS_OF_2019 and not path.is_file())
    return None if is_bundled else path


def copy_robot(path: Path, folder: Path) -> Path:
    """Copy a robot's file and all files that it names to a folder; return the path of the copy.

    Raises:
        ConfigError: If it names files outside its own folder, or the copy is not the same robot.
        OSError: If the files cannot be copied.
    """
    home = path.parent.resolve()
    # the robot's own file may be a link; links of other files are resolved
    files = {home / path.name, *(file.resolve() for file in robot_files(path) if file != path)}
    for outside in (file for file in files if not file.is_relative_to(home)):
        raise ConfigError(
            f"'robot_base': {path} names {outside}, which is outside its own folder, {home}."
        )
    for file in files:
        copy = folder / file.relative_to(home)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, copy)
    copy = folder / path.name
    if not is_robot(copy, folder, fingerprint(path)):
        raise ConfigError(f"'robot_base': a copy of {path} is another robot.")
    return copy


def is_robot(path: Path, folder: Path, content: str) -> bool:
    """Whether a robot's files have the fingerprint `content` and are all in a folder."""
    inside = folder.resolve()
    return fingerprint(path) == content and all(
        file.resolve().is_relative_to(inside) for file in robot_files(path)
    )
