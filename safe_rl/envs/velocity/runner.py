"""A robot: its model from Gymnasium's own MJCF file, observation, reward, health and pictures.

Health and reward are those of Gymnasium's environments of version 5 (Towers et al. 2024); intervals
are open or closed as there. The limited speed is that of Safety-Gymnasium (Ji et al. 2023).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import gymnasium
import mujoco
import numpy as np
import torch
from torch import Tensor

from safe_rl.envs.contract import add_columns
from safe_rl.envs.physics import Physics, put
from safe_rl.envs.physics.dynamics import SCALES, scale_dynamics
from safe_rl.envs.pictures import Camera, Marker, Pictures
from safe_rl.envs.velocity.velocity_config import PARTS, RUNNERS, Interval, VelocityConfig

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
DISTANCE, ELEVATION = 4.0, -20.0  # of the free camera from the robot [m, degrees], as Gymnasium's
COST_RGBA, COST_RADIUS = (1.0, 0.0, 0.0, 0.35), 0.3
TORSO = 1  # id of the torso, the first body of every robot
FORCES = "cfrc_ext"


class Place(NamedTuple):
    """The point whose velocity is limited.

    `torso` and `centre_of_mass` are read as `mj_step` leaves them: they belong to the last state
    that it evaluated.

    Attributes:
        outputs: Outputs of the physics that it needs.
        read: (physics, shares of the bodies in the mass [nbody, 1]) -> its position [N, D] (m). D
            is 1 for a limit on the velocity along x, and 2 for one on the planar speed.
    """

    outputs: tuple[str, ...]
    read: Callable[[Physics, Tensor], Tensor]


PLACES: Mapping[str, Place] = {
    "x": Place((), lambda p, shares: p.qpos[:, :1].clone()),
    "torso": Place(("xpos",), lambda p, shares: p.outputs["xpos"][:, TORSO, :2].clone()),
    "centre_of_mass": Place(
        ("xipos",), lambda p, shares: (p.outputs["xipos"][..., :2] * shares).sum(1)
    ),
}


def limited_speed(velocity: Tensor) -> Tensor:
    """Return the limited speed, the x velocity or the planar speed: [N, D] -> [N].

    As in Safety-Gymnasium, the x velocity is signed, so moving backwards costs nothing with it.
    """
    return velocity[:, 0] if velocity.shape[-1] == 1 else velocity.square().sum(-1).sqrt()


def _inside(value: Tensor, interval: Interval) -> Tensor:
    low, high = interval
    return (low < value) & (value < high)


def healthy(config: VelocityConfig, qpos: Tensor, qvel: Tensor) -> Tensor:
    """Return which robots are healthy, bool [N], from positions [N, nq] and velocities [N, nv].

    They are within the ranges that the robot has: of the torso's height and angle, and of all
    further positions and velocities.
    """
    height = qpos[:, RUNNERS[config.robot].num_hidden]
    is_healthy = torch.ones_like(height, dtype=torch.bool)
    if config.healthy_z_range is not None:
        low, high = config.healthy_z_range
        if config.robot == "ant":  # alone in Gymnasium, its interval is closed, its state finite
            finite = qpos.isfinite().all(-1) & qvel.isfinite().all(-1)
            return finite & (low <= height) & (height <= high)
        is_healthy &= _inside(height, config.healthy_z_range)
    if config.healthy_angle_range is not None:
        is_healthy &= _inside(qpos[:, 2], config.healthy_angle_range)
    if config.healthy_state_range is not None:
        state = torch.cat([qpos[:, 2:], qvel], -1)
        is_healthy &= _inside(state, config.healthy_state_range).all(-1)
    return is_healthy


def locomotion_reward(
    config: VelocityConfig,
    velocity_x: Tensor,
    control: Tensor,
    healthy: Tensor,
    outputs: Mapping[str, Tensor],
) -> Tensor:
    """Reward [N] for forward velocity and health, minus costs of control and contact.

    `velocity_x` (m/s) and `healthy` are [N], `control` is [N, nu]. With a contact weight,
    the output `cfrc_ext` [N, nbody, 6] (N m, N) of the physics is read.
    """
    reward = config.forward_reward_weight * velocity_x
    if config.healthy_reward is not None:
        reward = reward + config.healthy_reward * healthy
    reward = reward - config.ctrl_cost_weight * control.square().sum(-1)
    if config.contact_cost_weight:
        forces = outputs[FORCES]
        if config.contact_force_range is not None:
            forces = forces.clamp(*config.contact_force_range)
        cost = config.contact_cost_weight * forces.square().sum((-2, -1))
        if config.contact_cost_range is not None:
            cost = cost.clamp(*config.contact_cost_range)
        reward = reward - cost
    return reward


def load_model(config: VelocityConfig) -> mujoco.MjModel:
    """Compile a robot's file.

    If contact forces are needed, an added sensor makes MuJoCo compute them. It changes nothing else
    but `sensordata`. MuJoCo Warp lacks the solver of Humanoid's file (PGS); there, Newton's method
    minimises the same function.
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
    if config.physics == "warp":
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
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
    """A named component: its number of columns, and how to read it, [N, size]."""

    name: str
    size: int
    read: Callable[[Physics], Tensor]


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
        self._parts = _parts(config, model)
        self.columns = add_columns({}, {part.name: part.size for part in self._parts})
        self.size = sum(part.size for part in self._parts)

    def write(self, physics: Physics, observation: Tensor) -> None:
        """Write the observation of all robots after a step into [N, size]."""
        for part in self._parts:
            observation[:, self.columns[part.name]] = part.read(physics)

    def write_start(self, physics: Physics, observation: Tensor, mask: Tensor) -> None:
        """Write the observation before the first step of an episode in the rows of a mask [N].

        Contact forces are 0, because Gymnasium computes them only in a step.
        """
        start = torch.empty_like(observation)
        self.write(physics, start)
        if FORCES in self.columns:
            start[:, self.columns[FORCES]] = 0.0
        put(observation, mask, start)


def _parts(config: VelocityConfig, model: mujoco.MjModel) -> list[Part]:
    """Components of joints, of all bodies but the world, and forces at joints but the root's."""
    robot, moving = RUNNERS[config.robot], model.nbody - 1
    first = robot.num_hidden if config.exclude_current_positions_from_observation else 0
    limit = robot.velocity_limit
    low, high = config.contact_force_range or (-torch.inf, torch.inf)
    parts = [
        Part("qpos", model.nq - first, lambda physics: physics.qpos[:, first:]),
        Part("qvel", model.nv, lambda physics: physics.qvel.clamp(-limit, limit)),
        Part("cinert", 10 * moving, lambda p: p.outputs["cinert"][:, 1:].flatten(1)),
        Part("cvel", 6 * moving, lambda p: p.outputs["cvel"][:, 1:].flatten(1)),
        Part("qfrc_actuator", model.nv - 6, lambda p: p.outputs["qfrc_actuator"][:, 6:]),
        Part(FORCES, 6 * moving, lambda p: p.outputs[FORCES][:, 1:].flatten(1).clamp(low, high)),
    ]
    return [part for part in parts if part.name in ("qpos", "qvel", *observed_parts(config))]


class RobotRenderer(Pictures):
    """Draws the robots of one environment in their present state."""

    def __init__(self, config: VelocityConfig, physics: Physics) -> None:
        super().__init__()
        self._config, self._physics = config, physics

    def frames(
        self, rows: list[int], has_cost: Tensor, camera: Camera, width: int, height: int
    ) -> np.ndarray:
        """Draw robots `rows`, with a sphere where `has_cost` [N]: uint8 [R, height, width, 3]."""
        frames = np.empty((len(rows), height, width, 3), dtype=np.uint8)
        for frame, row in zip(frames, rows, strict=True):
            self.data.qpos[:] = self._physics.qpos[row].cpu().numpy()
            self.place()
            size, place = (COST_RADIUS,) * 3, self.data.xpos[TORSO]
            sphere = Marker(mujoco.mjtGeom.mjGEOM_SPHERE, size, place, COST_RGBA)
            frame[:] = self.frame(camera, width, height, [sphere] if has_cost[row] else [])
        return frames

    def free_cameras(self) -> dict[str, mujoco.MjvCamera]:
        """Return a camera beside the robot that moves with it."""
        free = mujoco.MjvCamera()
        free.type, free.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, TORSO
        free.distance, free.elevation = DISTANCE, ELEVATION
        return {"free": free}

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The model without shadows, which take most of the time in software OpenGL."""
        model = load_model(self._config)
        model.light_castshadow[:] = 0
        return model
