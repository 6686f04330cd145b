"""The interface of a physics backend: N MuJoCo simulations that are advanced together."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch
    from torch import Tensor


STATE = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat")
"""Tensors of the state, besides the memory of actuators and sensors."""
MEMORY = ("act", "history")
OUTPUTS = ("xpos", "xmat", "sensordata", "subtree_com")


class Physics(ABC):
    """N simulations of one model, advanced together on one device.

    Rules, layouts and observations use its tensors, device and floating-point type. Tensors keep
    their addresses: values that are written in place take effect at the next call, and every call
    refreshes the outputs of the simulations that it ran. Shapes have the sizes of the model (nq,
    nv, nu, nbody, nmocap).

    A step must not wait for an accelerator. Therefore code of a step uses `maybe_any`, `rows` and
    `check`, which read values only where the host need not wait, as on the CPU.

    Attributes:
        device: Device of the tensors.
        dtype: Their floating-point type.
        timestep: Duration of a substep [s].
        waits: Whether the host must wait for the device to read a value.
        time: [N] s.
        qpos, qvel, qacc_warmstart: State of the joints, [N, nq], [N, nv] and [N, nv].
        ctrl: Controls [N, nu].
        mocap_pos, mocap_quat: Poses of the mocap bodies [N, nmocap, 3] (m) and [N, nmocap, 4].
        memory: State of actuators and sensors with memory, `act` [N, na] and `history`
            [N, nhistory]; without entries that the model does not need.
        xpos, xmat, sensordata, subtree_com: The outputs, [N, nbody, 3] (m), [N, nbody, 3, 3],
            [N, nsensordata] and [N, nbody, 3] (m).
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

    @abstractmethod
    def reset(self, mask: Tensor) -> None:
        """Set the simulations in `mask` (bool [N]) to the model's initial state, awake."""

    @abstractmethod
    def forward(self, mask: Tensor | None = None) -> None:
        """Compute the outputs from the state, for all simulations or those in `mask`."""

    @abstractmethod
    def step(
        self,
        num_substeps: int,
        mocap_path: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> Tensor:
        """Advance by substeps under constant `ctrl`, then compute the outputs.

        Args:
            num_substeps: Number of substeps, S.
            mocap_path: Mocap positions before each substep [N, S, nmocap, 3]; None if they do not
                change.
            counts: A number of substeps for each simulation, at most S, int64 [N]; None means S.

        Returns:
            bool [N]: simulations that failed (non-finite or huge state); their state is finite
            again, but meaningless until a reset.
        """

    @abstractmethod
    def rays(self, origin: Tensor, directions: Tensor, group: int, exclude_body: int) -> Tensor:
        """Cast rays into the simulations as their state is now.

        Args:
            origin: Where the rays of each simulation start [N, 3] (m).
            directions: Unit vectors [N, R, 3].
            group: The geom group that rays can hit, 0 to 5.
            exclude_body: Id of a body whose own geoms rays cannot hit.

        Returns:
            Distance to the first surface [N, R] (m), -1 where there is none.
        """

    def maybe_any(self, mask: Tensor) -> bool:
        """Whether a mask may be True anywhere; True if the host would have to wait to know.

        Code that runs in this case must not change rows where the mask is False.
        """
        return self.waits or bool(mask.any())

    def rows(self, mask: Tensor) -> Tensor:
        """Return the indices of a mask's rows, int64; of all rows if the host would have to wait.

        Code that writes to these rows must apply the mask in any case.
        """
        return mask.new_ones(len(mask)).cumsum(0) - 1 if self.waits else mask.nonzero()[:, 0]

    def check(self, wrong: Tensor, error: Callable[[], Exception]) -> None:
        """Raise an error if `wrong` (bool) is True anywhere.

        On an accelerator, a later call may raise it. `error` makes the error, and may read tensors.
        """
        if wrong.any():
            raise error()
