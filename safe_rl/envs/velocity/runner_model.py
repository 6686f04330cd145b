"""A robot's model, from Gymnasium's own MJCF file: loading, observing and drawing it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import gymnasium
import mujoco
import numpy as np
import torch
from torch import Tensor

from safe_rl.envs.contract import add_columns
from safe_rl.envs.physics.batch import BatchPhysics
from safe_rl.envs.physics.dynamics import SCALES, scale_dynamics
from safe_rl.envs.pictures import Camera, Marker, Pictures
from safe_rl.envs.velocity.locomotion import FORCES, PLACES, TORSO
from safe_rl.envs.velocity.velocity_config import PARTS, RUNNERS, VelocityConfig

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
DISTANCE, ELEVATION = 4.0, -20.0  # of the free camera from the robot [m, degrees], as Gymnasium's
COST_RGBA, COST_RADIUS = (1.0, 0.0, 0.0, 0.35), 0.3


def load_model(config: VelocityConfig) -> mujoco.MjModel:
    """Compile a robot's file.

    If contact forces are needed, an added sensor makes MuJoCo compute them. It changes nothing else
    but `sensordata`.
    """
    spec = mujoco.MjSpec.from_file(str(ASSETS / RUNNERS[config.robot].mjcf))
    if needs_forces(config):
        torso = spec.bodies[TORSO]
        spec.add_sensor(
            name="forces",
            type=mujoco.mjtSensor.mjSENS_FRAMELINACC,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,
            objname=torso.name,
        )
    with warnings.catch_warnings():
        # The warnings are about Gymnasium's files, which users cannot change.
        warnings.filterwarnings("ignore", message="compiler attribute")
        model = spec.compile()
    scale_dynamics(model, {key: getattr(config, key) for key in SCALES}, slice(1, model.nbody))
    return model


def observed_parts(config: VelocityConfig) -> list[str]:
    """Fields of `MjData` that are observed besides positions and velocities, in order."""
    return [part for part in PARTS if getattr(config, f"include_{part}_in_observation")]


def needs_forces(config: VelocityConfig) -> bool:
    """Whether contact forces are observed or reduce the reward."""
    return FORCES in observed_parts(config) or bool(config.contact_cost_weight)


def needed_outputs(config: VelocityConfig) -> list[str]:
    """Fields of `MjData` that the physics must output, each once."""
    forces = [FORCES, "qacc"] if needs_forces(config) else []
    place = PLACES[RUNNERS[config.robot].place]
    return list(dict.fromkeys([*observed_parts(config), *place.outputs, *forces]))


class Part(NamedTuple):
    """A named component: its number of columns, and how to read it, float64 [N, size]."""

    name: str
    size: int
    read: Callable[[BatchPhysics], Tensor]


class Observer:
    """Reads the observation, a flat vector of named components.

    Args:
        config: The environment.
        model: Its compiled model.

    Attributes:
        columns: Columns of every component.
        size: Number of columns.
    """

    def __init__(self, config: VelocityConfig, model: mujoco.MjModel) -> None:
        self._parts = [*_joints(config, model), *_bodies(config, model)]
        self.columns = add_columns({}, {part.name: part.size for part in self._parts})
        self.size = sum(part.size for part in self._parts)

    def write(self, physics: BatchPhysics, observation: Tensor) -> None:
        """Write the observation of all robots after a step into [N, size]."""
        for part in self._parts:
            observation[:, self.columns[part.name]] = part.read(physics)

    def write_start(self, physics: BatchPhysics, observation: Tensor, rows: Tensor) -> None:
        """Write the observation of rows (int64 [R]) before the first step of an episode.

        Contact forces are 0, because Gymnasium computes them only in a step.
        """
        for part in self._parts:
            columns = self.columns[part.name]
            start = 0.0 if part.name == FORCES else part.read(physics)[rows].to(observation.dtype)
            observation[rows, columns] = start


def _joints(config: VelocityConfig, model: mujoco.MjModel) -> list[Part]:
    robot = RUNNERS[config.robot]
    first = robot.num_hidden if config.exclude_current_positions_from_observation else 0
    limit = robot.velocity_limit
    return [
        Part("qpos", model.nq - first, lambda physics: physics.qpos[:, first:]),
        Part("qvel", model.nv, lambda physics: physics.qvel.clamp(-limit, limit)),
    ]


def _bodies(config: VelocityConfig, model: mujoco.MjModel) -> list[Part]:
    """Components of all bodies but the world, and actuator forces of all joints but the root."""
    low, high = config.contact_force_range or (-torch.inf, torch.inf)
    moving = model.nbody - 1
    parts = [
        Part("cinert", 10 * moving, lambda p: p.outputs["cinert"][:, 1:].flatten(1)),
        Part("cvel", 6 * moving, lambda p: p.outputs["cvel"][:, 1:].flatten(1)),
        Part("qfrc_actuator", model.nv - 6, lambda p: p.outputs["qfrc_actuator"][:, 6:]),
        Part(FORCES, 6 * moving, lambda p: p.outputs[FORCES][:, 1:].flatten(1).clamp(low, high)),
    ]
    return [part for part in parts if part.name in observed_parts(config)]


class RobotRenderer(Pictures):
    """Draws the robots of one environment in their present state."""

    def __init__(self, config: VelocityConfig, physics: BatchPhysics) -> None:
        super().__init__()
        self._config, self._physics = config, physics

    def frames(
        self, rows: list[int], has_cost: Tensor, camera: Camera, width: int, height: int
    ) -> np.ndarray:
        """Draw robots `rows`, with a sphere where `has_cost` [N]: uint8 [R, height, width, 3]."""
        frames = np.empty((len(rows), height, width, 3), dtype=np.uint8)
        for frame, row in zip(frames, rows, strict=True):
            self.data.qpos[:] = self._physics.qpos[row].numpy()
            self.place()
            size, place = (COST_RADIUS,) * 3, self.data.xpos[TORSO]
            sphere = Marker(mujoco.mjtGeom.mjGEOM_SPHERE, size, place, COST_RGBA)
            frame[:] = self.frame(camera, width, height, [sphere] if has_cost[row] else [])
        return frames

    def free_camera(self) -> mujoco.MjvCamera:
        """Return a camera beside the robot that moves with it."""
        free = mujoco.MjvCamera()
        free.type, free.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, TORSO
        free.distance, free.elevation = DISTANCE, ELEVATION
        return free

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The model without shadows, which take most of the time in software OpenGL."""
        model = load_model(self._config)
        model.light_castshadow[:] = 0
        return model
