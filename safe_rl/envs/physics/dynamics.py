"""Factors on a robot's dynamics: mass, friction, damping and strength, fixed or per episode.

Fixed factors change the compiled model. Those that are drawn for every episode change the fields of
the model that every simulation has for itself. A batch is as fast with both as without.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from safe_rl.envs import rng
from safe_rl.envs.keys import ConfigError

SCALES: dict[str, tuple[str, ...]] = {
    "mass_scale": ("body_mass", "body_inertia"),
    # a contact uses the larger coefficients of its two surfaces, so all surfaces must change
    "friction_scale": ("geom_friction", "pair_friction"),
    "damping_scale": ("dof_damping", "dof_dampingpoly"),
    "strength_scale": (
        *("actuator_gainprm", "actuator_biasprm"),
        *("actuator_forcerange", "jnt_actfrcrange"),
    ),
}
"""Key of a configuration -> the fields of `MjModel` that its factor multiplies."""

_LINEAR = {
    "actuator_gaintype": (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE),
    "actuator_biastype": (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE),
}
_DRAW = -2  # differs from the other purposes of draws with an episode's key, and from step numbers


def scale_dynamics(model: mujoco.MjModel, scales: Mapping[str, Any], bodies: slice) -> None:
    """Change a compiled model in place by the factors of a robot, whose body ids are `bodies`.

    `scales` has a factor by key of `SCALES`; missing ones are 1. A factor of 1 changes no bit, and
    ranges of factors change nothing here.

    Raises:
        ConfigError: If the force of an actuator is no linear function of its gain, as for a muscle.
    """
    for key, fields in SCALES.items():
        factor = scales.get(key, 1.0)
        if factor == 1.0 or isinstance(factor, tuple):
            continue
        _check_linear(model, key)
        before = model.dof_M0.mean()
        for field in fields:
            getattr(model, field)[_rows(model, field, bodies)] *= factor
        if key == "mass_scale":
            # what the compiler derives from masses, and `meaninertia`, which this call leaves out
            mujoco.mj_setConst(model, mujoco.MjData(model))
            model.stat.meaninertia *= model.dof_M0.mean() / before


def _rows(model: mujoco.MjModel, field: str, bodies: slice) -> Any:
    """The rows of a field that belong to the robot, or to what its factor means."""
    if field.startswith("body"):
        return bodies
    if field.startswith("dof"):
        return np.isin(model.dof_bodyid, np.arange(model.nbody)[bodies]).nonzero()[0]
    return slice(None)


def _check_linear(model: mujoco.MjModel, key: str) -> None:
    for kind, linear in _LINEAR.items():
        if key == "strength_scale" and not {*getattr(model, kind).tolist()} <= {*map(int, linear)}:
            raise ConfigError(
                "'strength_scale' is for actuators whose force is linear in their gain: motors, "
                "position and velocity servos. This robot has others."
            )


class DrawnDynamics:
    """Factors that every simulation draws for each of its episodes, uniformly from a range.

    Args:
        model: The compiled model.
        batch: N simulations of it.
        ranges: Key of `SCALES` -> lowest and highest factor.
        bodies: Ids of the robot's bodies.

    Attributes:
        factors: The present factors [N, K], in the order of `ranges`.

    Raises:
        ConfigError: As `scale_dynamics`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        batch: Batch,
        ranges: Mapping[str, tuple[float, float]],
        bodies: slice,
    ) -> None:
        self._batch, self._has_masses = batch, "mass_scale" in ranges
        bounds = torch.tensor([*ranges.values()], dtype=torch.float64)
        self._low, self._width = bounds[:, 0], bounds[:, 1] - bounds[:, 0]
        self.factors = torch.ones(batch.nsim, len(ranges), dtype=torch.float64)
        self._scaled = []  # column of the factor, values [N, …], those of the model, their rows
        for column, key in enumerate(ranges):
            _check_linear(model, key)
            for field in SCALES[key]:
                rows = _rows(model, field, bodies)
                self._scaled.append((column, batch.expand(field), getattr(model, field), rows))

    def draw(self, key: Tensor, mask: Tensor) -> None:
        """Draw the factors of the episodes with keys [N] in the simulations of a mask [N]."""
        columns = torch.arange(self.factors.shape[1])
        draws = rng.uniform(key[:, None], _DRAW, columns)
        self.set(torch.where(mask[:, None], self._low + self._width * draws, self.factors), mask)

    def set(self, factors: Tensor, mask: Tensor) -> None:
        """Set the factors [N, K] of the simulations of a mask [N]; outputs follow later."""
        self.factors = factors.clone()
        chosen = mask.nonzero()[:, 0].numpy()
        for column, values, base, rows in self._scaled:
            factor = factors[chosen, column].numpy().reshape(-1, *[1] * base.ndim)
            scaled = np.repeat(base[None], len(chosen), 0)
            scaled[:, rows] *= factor
            values[chosen] = scaled
        if self._has_masses and len(chosen):
            self._batch.set_const(chosen)
