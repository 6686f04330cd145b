"""N MuJoCo simulations that are advanced together: the interface of a backend, and the CPU's.

The CPU's is `mujoco.batch.Batch`, a C++ thread pool over rows of state.
"""

from __future__ import annotations

import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

STATE = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat")
"""Tensors of the state, besides that of actuators and sensors."""
RESTORED = ("qpos", "qvel", "qacc_warmstart", "time")
"""Those of them that every stored state of an environment contains."""
ACTUATOR_STATE = ("act", "history")
OUTPUTS = ("xpos", "xmat", "sensordata", "subtree_com")
"""Outputs that Safety Gym's worlds read."""


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
        actuator_state: State of filtered and delayed actuators and sensors, `act` [N, na] and
            `history` [N, nhistory]; without entries that the model does not need.
        outputs: Fields of `MjData` that are read, by name, such as `xpos` [N, nbody, 3] (m).
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
    actuator_state: Mapping[str, Tensor]
    outputs: Mapping[str, Tensor]

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
        refresh: bool = True,
    ) -> Tensor:
        """Advance by substeps under constant `ctrl`, then compute the outputs.

        Args:
            num_substeps: Number of substeps, S.
            mocap_path: Mocap positions before each substep [N, S, nmocap, 3]; None if they do not
                change.
            counts: A number of substeps for each simulation, at most S, int64 [N]; None means S.
                Only on the CPU.
            refresh: Whether the outputs are those of the state that is reached. If not, they stay
                as `mj_step` leaves them: those of the last state that the last substep evaluated,
                with the Runge-Kutta integrator its fourth stage.

        Returns:
            bool [N]: simulations that failed (non-finite or huge state); their state is finite
            again, but meaningless until a reset.
        """

    def rays(self, origin: Tensor, directions: Tensor, group: int, exclude_body: int) -> Tensor:
        """Cast rays into the simulations as their state is now, only on the CPU.

        Args:
            origin: Where the rays of each simulation start [N, 3] (m).
            directions: Unit vectors [N, R, 3].
            group: The geom group that rays can hit, 0 to 5.
            exclude_body: Id of a body whose own geoms rays cannot hit.

        Returns:
            Distance to the first surface [N, R] (m), -1 where there is none.
        """
        raise NotImplementedError

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


def put(target: Tensor, mask: Tensor, values: Tensor) -> None:
    """Write values [N, ...] to a tensor [N, ...] in the rows of a mask [N]."""
    target.copy_(torch.where(mask.view(-1, *[1] * (target.ndim - 1)), values, target))


_PATH_INPUTS = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_MOCAP_POS)
_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
_NO_STAGE = int(mujoco.mjtStage.mjSTAGE_NONE)


class BatchPhysics(Physics):
    """N simulations on the CPU, in float64.

    Threads do not survive a fork: the process that steps simulations with several threads must
    make them itself, or be spawned.

    Args:
        model: The compiled model; sleeping follows its options.
        num_envs: Number of simulations, N.
        num_threads: Threads that step them, 0 for one per core.
        outputs: Names of the fields of `MjData` that are read; every call copies them.
    """

    device = torch.device("cpu")
    dtype = torch.float64
    waits = False

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        num_threads: int,
        outputs: Sequence[str] = OUTPUTS,
    ) -> None:
        log = mujoco.MjLogConfig.get()
        log.logto_file = False  # or MuJoCo writes MUJOCO_LOG.TXT into the working directory
        log.logto_console = False  # a line for every failure; `failed` has one for all of them
        log.set()
        sleeps = bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP)
        has_threads = (num_threads or os.cpu_count() or 1) > 1
        self._process = os.getpid() if has_threads else None
        self.timestep = float(model.opt.timestep)
        self.batch = Batch(model, num_envs, num_threads, persistent=sleeps)
        # All fields are bound before the first call: a field that is bound later starts as zero.
        sizes = zip(ACTUATOR_STATE, (model.na, model.nhistory), strict=True)
        delayed = [name for name, size in sizes if size]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
            bound = {
                name: torch.from_numpy(self.batch.bind(name))
                for name in (*STATE, *delayed, *outputs)
            }
        for name in STATE:
            setattr(self, name, bound[name])
        self.actuator_state = {name: bound[name] for name in delayed}
        self.outputs = {name: bound[name] for name in outputs}
        if "xmat" in self.outputs:
            self.outputs["xmat"] = self.outputs["xmat"].view(num_envs, model.nbody, 3, 3)
        self._disableflags = self.batch.expand("opt.disableflags")
        self._with_sensors = int(model.opt.disableflags)
        self._warnings = np.zeros_like(self.batch.warning)
        self._has_failed = False

    def reset(self, mask: Tensor) -> None:
        """Set the simulations in `mask` to the model's initial state, see `Physics`."""
        self._check_process()
        self.batch.reset(mask.numpy(), stage=_NO_STAGE)
        self._warnings[:] = self.batch.warning

    def forward(self, mask: Tensor | None = None, sensors: bool = True) -> None:
        """Compute the outputs from the state, see `Physics`.

        Without `sensors`, the readings, and quantities that only sensors need, stay unchanged.
        """
        self._check_process()
        self._disableflags[:] = self._with_sensors | (0 if sensors else _NO_SENSORS)
        self.batch.forward(None if mask is None else mask.numpy())
        self._disableflags[:] = self._with_sensors

    def step(
        self,
        num_substeps: int,
        mocap_path: Tensor | None = None,
        counts: Tensor | None = None,
        refresh: bool = True,
    ) -> Tensor:
        """Advance by substeps and compute the outputs, see `Physics`."""
        self._check_process()
        # Sensors are not read between substeps; without them the result is the same to the bit.
        self._disableflags[:] = self._with_sensors | _NO_SENSORS
        if counts is None:
            self._substeps(num_substeps, mocap_path, None)
        else:
            for count in counts.unique().tolist():
                self._substeps(count, mocap_path, (counts == count).numpy())
        self._disableflags[:] = self._with_sensors
        if refresh:
            self.batch.forward()
        return self.failed()

    def failed(self) -> Tensor:
        """Return the simulations that failed since the last call of this or `step`, bool [N]."""
        # MuJoCo resets a bad state by itself, and only increments a warning counter.
        counts = self.batch.warning
        if np.array_equal(counts, self._warnings):
            return torch.zeros(len(counts), dtype=torch.bool, device=self.device)
        failed = (counts[..., 1] > self._warnings[..., 1]).any(-1)
        counts[failed] = 0  # a next failure increments them again
        self._warnings[:] = counts
        self.ctrl[failed] = 0.0
        if failed.any() and not self._has_failed:
            self._has_failed = True
            warnings.warn(
                f"The physics of {failed.sum()} of {len(failed)} simulations failed (a state that "
                "is huge or no number): their episodes end. Later failures are not shown. If all "
                "fail, check the robot's file and the actions.",
                RuntimeWarning,
                stacklevel=2,
            )
        return torch.from_numpy(failed)

    def rays(self, origin: Tensor, directions: Tensor, group: int, exclude_body: int) -> Tensor:
        """Cast rays into the simulations as their state is now, see `Physics`."""
        seen = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
        seen[group] = 1
        distance, _ = self.batch.ray(
            origin.numpy()[:, None], directions.numpy(), geomgroup=seen, bodyexclude=exclude_body
        )
        return torch.from_numpy(distance)

    def _check_process(self) -> None:
        """Raise in a forked process: it has no threads, and would wait for them for ever."""
        if self._process is not None and self._process != os.getpid():
            raise RuntimeError(
                "This environment was made before its process was forked, and its threads do not "
                "survive a fork. Make it in the process that steps it, start processes with the "
                "method 'spawn', or give it num_threads=1."
            )

    def _substeps(self, count: int, path: Tensor | None, mask: np.ndarray | None) -> None:
        if count == 0:
            return
        if path is None:
            self.batch.rollout(count, record=(), ids=mask)
            return
        rows = slice(None) if mask is None else torch.from_numpy(mask)
        moved = path[rows, :count].flatten(2)
        control = torch.cat([self.ctrl[rows, None].expand(-1, count, -1), moved], -1)
        self.batch.rollout(count, control.numpy(), _PATH_INPUTS, record=(), ids=mask)
