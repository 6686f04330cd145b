"""Dynamics that differ from a robot's file by factors: mass, friction, damping, strength.

Factors change the compiled model, so that a batch is as fast with them as without.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import mujoco
import numpy as np

from safe_rl.envs.errors import ConfigError

__all__ = ["SCALES", "scale_dynamics"]

_LINEAR = (
    {int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)},
    {int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)},
)


def scale_dynamics(model: mujoco.MjModel, scales: Mapping[str, float], bodies: slice) -> None:
    """Change a compiled model in place; what has the factor 1 stays as it is to the bit.

    Args:
        model: the model.
        scales: a factor for each of `SCALES`; others are 1.
        bodies: the robot's.

    Raises:
        ConfigError: if an actuator's force is no linear function of its gain, as a muscle's.
    """
    for name, scale in SCALES.items():
        factor = scales.get(name, 1.0)
        if factor != 1.0:
            scale(model, bodies, factor)


def _mass(model: mujoco.MjModel, bodies: slice, factor: float) -> None:
    before = model.dof_M0.mean()
    model.body_mass[bodies] *= factor
    model.body_inertia[bodies] *= factor
    # what the compiler derives from masses; the unit of the solver's tolerance is left out there
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.stat.meaninertia *= model.dof_M0.mean() / before


def _friction(model: mujoco.MjModel, bodies: slice, factor: float) -> None:
    # of two surfaces that touch, MuJoCo takes the larger coefficients: all of them change
    model.geom_friction *= factor
    model.pair_friction *= factor


def _damping(model: mujoco.MjModel, bodies: slice, factor: float) -> None:
    of_robot = np.isin(model.dof_bodyid, np.arange(model.nbody)[bodies])
    model.dof_damping[of_robot] *= factor
    model.dof_dampingpoly[of_robot] *= factor


def _strength(model: mujoco.MjModel, bodies: slice, factor: float) -> None:
    kinds = (model.actuator_gaintype, model.actuator_biastype)
    for kind, linear in zip(kinds, _LINEAR, strict=True):
        if not set(kind.tolist()) <= linear:
            raise ConfigError(
                "'strength_scale' is for actuators whose force grows with their gain: motors, "
                "position and velocity servos. Those of this robot are others."
            )
    for values in (
        *(model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange),
        model.jnt_actfrcrange,
    ):
        values *= factor


Scale = Callable[[mujoco.MjModel, slice, float], None]
SCALES: dict[str, Scale] = {
    "mass_scale": _mass,
    "friction_scale": _friction,
    "damping_scale": _damping,
    "strength_scale": _strength,
}
"""Key of a configuration -> what changes the model."""
