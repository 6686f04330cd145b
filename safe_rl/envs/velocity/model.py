"""The simulated model: Gymnasium's own MJCF file, and what of it is read."""

from __future__ import annotations

import warnings
from pathlib import Path

import gymnasium
import mujoco

from safe_rl.envs.physics.dynamics import SCALES, scale_dynamics
from safe_rl.envs.velocity.config import VelocityConfig
from safe_rl.envs.velocity.measuring import PLACES, TORSO
from safe_rl.envs.velocity.robots import ROBOTS

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
FORCES = "cfrc_ext"


def load_model(config: VelocityConfig) -> mujoco.MjModel:
    """Compile a robot's file, with a sensor that asks for contact forces where they are needed.

    The sensor changes nothing but `sensordata`.
    """
    spec = mujoco.MjSpec.from_file(str(ASSETS / ROBOTS[config.robot].mjcf))
    if needs_forces(config):
        torso = spec.bodies[TORSO]
        spec.add_sensor(
            name="forces",
            type=mujoco.mjtSensor.mjSENS_FRAMELINACC,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,
            objname=torso.name,
        )
    with warnings.catch_warnings():
        # Nobody who trains can change Gymnasium's files.
        warnings.filterwarnings("ignore", message="compiler attribute")
        model = spec.compile()
    scale_dynamics(model, {key: getattr(config, key) for key in SCALES}, slice(1, model.nbody))
    return model


def observed_parts(config: VelocityConfig) -> list[str]:
    """Fields of `MjData` that are observed beyond positions and velocities, in order."""
    parts = ROBOTS[config.robot].parts
    return [part for part in parts if getattr(config, f"include_{part}_in_observation")]


def needs_forces(config: VelocityConfig) -> bool:
    """Whether contact forces are observed or cost something."""
    return FORCES in observed_parts(config) or bool(config.contact_cost_weight)


def needed_outputs(config: VelocityConfig) -> list[str]:
    """Fields that the physics has to copy out, each once."""
    forces = [FORCES, "qacc"] if needs_forces(config) else []
    place = PLACES[ROBOTS[config.robot].place]
    return list(dict.fromkeys([*observed_parts(config), *place.outputs, *forces]))
