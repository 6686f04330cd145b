"""What the environment needs of a physics backend."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from torch import Tensor


class Physics(Protocol):
    """N simulations of one model, advanced together.

    The tensors keep their addresses: state fields are written in place and take effect at the
    next call, outputs are refreshed by every call for the simulations it ran. Floats are float64
    on the CPU backend. Shapes have the sizes of the model (nq, nv, nu, nbody, nmocap).
    """

    # state
    time: Tensor  # [N] s
    qpos: Tensor  # [N, nq]
    qvel: Tensor  # [N, nv]
    qacc_warmstart: Tensor  # [N, nv]
    ctrl: Tensor  # [N, nu]
    mocap_pos: Tensor  # [N, nmocap, 3] m
    mocap_quat: Tensor  # [N, nmocap, 4]
    # of actuators and sensors that remember: `act` [N, na], `history` [N, nhistory]; else empty
    memory: Mapping[str, Tensor]
    # outputs
    xpos: Tensor  # [N, nbody, 3] m
    xmat: Tensor  # [N, nbody, 3, 3]
    sensordata: Tensor  # [N, nsensordata]
    subtree_com: Tensor  # [N, nbody, 3] m
    # all outputs that were asked for, by their names in MjData
    outputs: Mapping[str, Tensor]

    @property
    def timestep(self) -> float:
        """Length of one substep [s]."""

    def reset(self, mask: Tensor) -> None:
        """Set the simulations in `mask` (bool [N]) to the model's initial state, awake."""

    def forward(self, mask: Tensor | None = None, sensors: bool = True) -> None:
        """Bring the outputs up to date with the state, for all simulations or those in `mask`.

        Without `sensors`, the readings and what is computed for them alone stay as they are.
        """

    def step(
        self, num_substeps: Tensor | int, mocap_path: Tensor | None = None, refresh: bool = True
    ) -> Tensor:
        """Advance by substeps under constant `ctrl`, then bring the outputs up to date.

        Args:
            num_substeps: one number for all, or int64 [N].
            mocap_path: mocap positions before each substep [N, S, nmocap, 3], or None where
                nothing moves.
            refresh: False leaves the outputs as `mj_step` does: of the state that the last
                substep evaluated last, which with the Runge-Kutta integrator is its fourth stage.

        Returns:
            bool [N]: simulations that failed (non-finite or huge state); their state is finite
            again but meaningless until reset.
        """

    def failed(self) -> Tensor:
        """Return the simulations that failed since the last call of this or `step`, bool [N]."""

    def rays(self, origin: Tensor, directions: Tensor, group: int, exclude_body: int) -> Tensor:
        """Cast rays into the simulations as their state is now.

        Args:
            origin: where the rays of each simulation start [N, 3] (m).
            directions: unit vectors [N, R, 3].
            group: the geom group that is seen, 0 to 5.
            exclude_body: id of a body whose own geoms are not seen.

        Returns:
            Distance to the first surface [N, R] (m), -1 where there is none.
        """
