"""MuJoCo, a batch of worlds at a time: what environments ask of a physics backend."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch
    from torch import Tensor


STATE = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat")
"""What the simulations are in, beside the memory of actuators and sensors."""
MEMORY = ("act", "history")
OUTPUTS = ("xpos", "xmat", "sensordata", "subtree_com")
"""What is read of them, unless others are asked for."""


class Physics(ABC):
    """N simulations of one model, advanced together on one device.

    Rules, layouts and observations are made of its tensors, on its device and of its floating-point
    type. Tensors keep their addresses: what is written into them in place takes effect at the next
    call, and every call refreshes the outputs of the simulations that it ran. Shapes have the sizes
    of the model (nq, nv, nu, nbody, nmocap).

    A step must not wait for an accelerator. So whoever takes part in it asks `maybe_any`, `rows`
    and `check`, which look at values only where that costs nothing, as on the CPU.

    Attributes:
        device: where the tensors are.
        dtype: their floating-point type.
        timestep: length of a substep [s].
        waits: whether the host would have to wait for the device in order to look at a value.
        time: [N] s.
        qpos, qvel, qacc_warmstart: state of the joints, [N, nq] and [N, nv].
        ctrl: controls [N, nu].
        mocap_pos, mocap_quat: poses of the mocap bodies [N, nmocap, 3] (m) and [N, nmocap, 4].
        memory: state of actuators and sensors that remember, `act` [N, na] and `history`
            [N, nhistory]; empty where there are none.
        xpos, xmat, sensordata, subtree_com: outputs that are there unless others were asked for,
            [N, nbody, 3] (m), [N, nbody, 3, 3], [N, nsensordata] and [N, nbody, 3] (m).
        outputs: all outputs that were asked for, by their names in MuJoCo's `MjData`.
    """

    device: torch.device
    dtype: torch.dtype
    timestep: float
    waits: bool
    time: Tensor
    qpos: Tensor
    qvel: Tensor
    qacc_warmstart: Tensor
    ctrl: Tensor
    mocap_pos: Tensor
    mocap_quat: Tensor
    memory: Mapping[str, Tensor]
    xpos: Tensor
    xmat: Tensor
    sensordata: Tensor
    subtree_com: Tensor
    outputs: Mapping[str, Tensor]

    @abstractmethod
    def reset(self, mask: Tensor) -> None:
        """Set the simulations in `mask` (bool [N]) to the model's initial state, awake."""

    @abstractmethod
    def forward(self, mask: Tensor | None = None, sensors: bool = True) -> None:
        """Bring the outputs up to date with the state, for all simulations or those in `mask`.

        Without `sensors`, the readings and what is computed for them alone stay as they are.
        """

    @abstractmethod
    def step(
        self,
        num_substeps: int,
        mocap_path: Tensor | None = None,
        refresh: bool = True,
        counts: Tensor | None = None,
    ) -> Tensor:
        """Advance by substeps under constant `ctrl`, then bring the outputs up to date.

        Args:
            num_substeps: S, how many.
            mocap_path: Mocap positions before each substep [N, S, nmocap, 3], or None where
                nothing moves.
            refresh: False leaves the outputs as `mj_step` does: of the state that the last
                substep evaluated last, which with the Runge-Kutta integrator is its fourth stage.
            counts: How many each simulation takes instead, at most S, int64 [N].

        Returns:
            bool [N]: simulations that failed (non-finite or huge state); their state is finite
            again but meaningless until reset.
        """

    @abstractmethod
    def failed(self) -> Tensor:
        """Return the simulations that failed since the last call of this or `step`, bool [N]."""

    @abstractmethod
    def rays(self, origin: Tensor, directions: Tensor, group: int, exclude_body: int) -> Tensor:
        """Cast rays into the simulations as their state is now.

        Args:
            origin: Where the rays of each simulation start [N, 3] (m).
            directions: Unit vectors [N, R, 3].
            group: The geom group that is seen, 0 to 5.
            exclude_body: Id of a body whose own geoms are not seen.

        Returns:
            Distance to the first surface [N, R] (m), -1 where there is none.
        """

    def maybe_any(self, mask: Tensor) -> bool:
        """Whether a mask may hold anywhere: where that is unknown without waiting, True.

        What is done then must change nothing where the mask does not hold.
        """
        return self.waits or bool(mask.any())

    def rows(self, mask: Tensor) -> Tensor:
        """Return indices of rows that include those of a mask, int64.

        They are just those, or all where that is unknown without waiting: what is written for the
        rows is masked in any case.
        """
        return mask.new_ones(len(mask)).cumsum(0) - 1 if self.waits else mask.nonzero()[:, 0]

    def check(self, wrong: Tensor, error: Callable[[], Exception]) -> None:
        """Raise an error if `wrong` (bool) holds anywhere; a device may look at it later.

        Args:
            wrong: Where something is wrong.
            error: Makes the error, and may look at tensors.
        """
        if wrong.any():
            raise error()
