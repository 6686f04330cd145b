"""Factors that change a robot's dynamics: mass, friction, damping and strength.

They change the compiled model, so a batch is as fast with them as without.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import mujoco
import numpy as np

from safe_rl.envs.keys import ConfigError

_LINEAR = (
    {int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE)},
    {int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)},
)


def scale_dynamics(model: mujoco.MjModel, scales: Mapping[str, float], bodies: slice) -> None:
    """Change a compiled model in place by the factors of a robot, whose body ids are `bodies`.

    `scales` has a factor by key of `SCALES`; missing ones are 1. A factor of 1 changes no bit.

    Raises:
        ConfigError: If the force of an actuator is no linear function of its gain, as for a muscle.
    """
    for name, scale in SCALES.items():
        factor = scales.get(name, 1.0)
        if factor != 1.0:
            scale(model, bodies, factor)


def _mass(model: mujoco.MjModel, bodies: slice, factor: float) -> None:
    before = model.dof_M0.mean()
    model.body_mass[bodies] *= factor
    model.body_inertia[bodies] *= factor
    # update what the compiler derives from masses, and `meaninertia`, which this call leaves out
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.stat.meaninertia *= model.dof_M0.mean() / before


def _friction(model: mujoco.MjModel, bodies: slice, factor: float) -> None:
    # a contact uses the larger coefficients of its two surfaces, so all surfaces must change
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
                "'strength_scale' is for actuators whose force is linear in their gain: motors, "
                "position and velocity servos. This robot has others."
            )
    model.actuator_gainprm *= factor
    model.actuator_biasprm *= factor
    model.actuator_forcerange *= factor
    model.jnt_actfrcrange *= factor


Scale = Callable[[mujoco.MjModel, slice, float], None]
SCALES: dict[str, Scale] = {
    "mass_scale": _mass,
    "friction_scale": _friction,
    "damping_scale": _damping,
    "strength_scale": _strength,
}
"""Key of a configuration -> function that changes the model by a factor."""
