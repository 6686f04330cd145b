"""Robots: loading an MJCF file, and what an environment needs of it.

A robot file describes a body named "robot" at the top level of its world, which stands upright and
is placed by its root joint: a free joint, or slides along x and y and a hinge about z. Its geom
defaults hold for the whole world. An actuator without a `ctrlrange` gets [-1, 1].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.safety_gym.rules.robot_files import robot_files

BUNDLED = Path(__file__).parents[1] / "robots"
ROBOTS: dict[str, Path] = {path.stem: path for path in sorted(BUNDLED.glob("*.xml"))}
# As the dictionaries of 2019 name them, from the folder of that package.
PATHS_OF_2019 = {f"xmls/{name}.xml": name for name in ROBOTS}

CONTROL_RANGE = (-1.0, 1.0)  # of actuators whose file gives none
_PLANAR_JOINTS = (
    mujoco.mjtJoint.mjJNT_SLIDE,
    mujoco.mjtJoint.mjJNT_SLIDE,
    mujoco.mjtJoint.mjJNT_HINGE,
)
_OF_THE_ROBOT = ("body_", "geom_", "jnt_", "dof_", "site_", "actuator_", "qpos")
_PLANAR_AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


@dataclass(frozen=True)
class Robot:
    """A robot that an environment can be built around.

    Attributes:
        spec: what its file describes, to build the world in.
        num_bodies: its bodies, the first ones of the world after the world body itself.
        num_sensors: its sensors, the first ones of the world.
        planar: whether the root is (x, y, yaw) instead of a free joint.
    """

    spec: mujoco.MjSpec
    num_bodies: int
    num_sensors: int
    planar: bool


def robot_path(base: str) -> Path:
    """Return the file of a name in `ROBOTS`, or of a path."""
    return ROBOTS.get(base, Path(base))


def load_robot(base: str) -> Robot:
    """Load a robot and check that it can be placed, moved and stepped.

    Args:
        base: a name in `ROBOTS`, or the path of an MJCF file.

    Raises:
        ConfigError: if MuJoCo cannot load the file, or the file lacks what an environment needs.

    Examples:
        >>> load_robot("car").planar
        False
    """
    path = robot_path(base)
    robot_files(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for key in list(spec.keys):
            spec.delete(key)  # a pose of the robot alone is no pose of the world
        model = spec.copy().compile()
    except (ValueError, RuntimeError, MemoryError) as error:
        raise ConfigError(f"'robot_base': MuJoCo cannot load {path}: {error}") from error
    _check_numbers(model, path)
    _check_body(model, path)
    for actuator, limited in zip(spec.actuators, model.actuator_ctrllimited, strict=True):
        if not limited:
            actuator.ctrlrange, actuator.ctrllimited = CONTROL_RANGE, True
    return Robot(spec, model.nbody - 1, model.nsensor, _is_planar(model, path))


def _lacks(path: Path, what: str) -> ConfigError:
    return ConfigError(f"'robot_base': {path} {what}")


def _check_numbers(model: mujoco.MjModel, path: Path) -> None:
    """Refuse numbers that no simulation gets along with, and that MuJoCo takes."""
    if not 0.0 < model.opt.timestep < np.inf:
        raise _lacks(path, f"has the timestep {model.opt.timestep}: it must be greater than 0.")
    for name in (name for name in dir(model) if name.startswith(_OF_THE_ROBOT)):
        values = getattr(model, name)
        if isinstance(values, np.ndarray) and values.dtype.kind == "f" and np.isnan(values).any():
            raise _lacks(path, f"has NaN in '{name}': give every mass, size and gain a number.")
    if not (np.isfinite(model.body_mass).all() and np.isfinite(model.body_inertia).all()):
        raise _lacks(path, "has a body of infinite mass or inertia.")
    for (low, high), limited in zip(
        model.actuator_ctrlrange.tolist(), model.actuator_ctrllimited, strict=True
    ):
        # MuJoCo takes a reversed range for none.
        if not math.isfinite(high - low) or low > high or (limited and low == high):
            raise _lacks(
                path,
                f"has the control range [{low}, {high}]: every 'ctrlrange' must be finite, the "
                "lower bound first.",
            )


def _check_body(model: mujoco.MjModel, path: Path) -> None:
    names = [model.body(i).name for i in range(1, model.nbody)]
    if "robot" not in names:
        hint = nearest("robot", names) or f" Its bodies are {names}."
        raise _lacks(path, f"has no body named 'robot'.{hint} Name the robot's root body so.")
    body = model.body("robot").id
    if model.body_parentid[body] != 0:
        parent = model.body(model.body_parentid[body]).name
        raise _lacks(path, f"has its body 'robot' inside '{parent}': put it into the worldbody.")
    if model.body_quat[body].tolist() != [1, 0, 0, 0]:
        raise _lacks(
            path,
            "turns its body 'robot': a reset sets the body upright with a random yaw, so give the "
            "rotation to geoms or child bodies instead.",
        )
    if model.nu == 0:
        raise _lacks(path, "has no actuators: add at least one, for there is no action without.")
    if model.nmocap:
        raise _lacks(path, "has mocap bodies, which no robot can move: make them ordinary bodies.")


def _is_planar(model: mujoco.MjModel, path: Path) -> bool:
    """Whether the root is (slide x, slide y, hinge z); else it must be a free joint."""
    body = model.body("robot").id
    first, number = model.body_jntadr[body], model.body_jntnum[body]
    joints = slice(first, first + min(number, 3))
    types = tuple(model.jnt_type[joints])
    if first > 0:
        raise _lacks(path, "has joints before those of the body 'robot': put that body first.")
    if types[:1] == (mujoco.mjtJoint.mjJNT_FREE,):
        return False
    if types != _PLANAR_JOINTS or model.jnt_axis[joints].tolist() != _PLANAR_AXES:
        raise _lacks(
            path,
            "cannot be placed: the body 'robot' needs a free joint, or slides along x and y and a "
            "hinge about z in this order.",
        )
    origin = (*model.body_pos[body, :2], *model.jnt_pos[joints, :2].flat, *model.qpos0[:3])
    if any(origin):
        raise _lacks(
            path,
            "moves its planar root away from the origin: x and y of the body 'robot' and of its "
            "joints, and their 'ref', must be 0, so that the joints are the robot's coordinates.",
        )
    return True
