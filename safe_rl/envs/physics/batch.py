"""N simulations on `mujoco.batch.Batch`, a C++ thread pool over rows of state."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

_STATE = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat")
_MEMORY = ("act", "history")
_OUTPUTS = ("xpos", "xmat", "sensordata", "subtree_com")
_PATH_INPUTS = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_MOCAP_POS)
_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
_NO_STAGE = int(mujoco.mjtStage.mjSTAGE_NONE)


def _log_to_console_only() -> None:
    """Keep MuJoCo from leaving a MUJOCO_LOG.TXT in the working directory."""
    log = mujoco.MjLogConfig.get()
    log.logto_file = False
    log.set()


def _share(array: np.ndarray) -> Tensor:
    """Wrap an array without copying it; outputs are read-only, which torch warns of."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The given NumPy array is not writable")
        return torch.from_numpy(array)


class BatchPhysics:
    """N simulations of one model, advanced together.

    The tensors, float64 on the CPU, keep their addresses: what is written into them in place takes
    effect at the next call, outputs are refreshed by every call for the simulations it ran. Shapes
    have the sizes of the model (nq, nv, nu, nbody, nmocap).

    Threads do not survive a fork: simulations with several of them are made in the process that
    steps them, or that process is spawned.

    Args:
        model: the compiled model; sleeping follows its options.
        num_envs: number of simulations, N.
        num_threads: threads that step them, 0 for one per core.
        outputs: names of the fields of `MjData` that are read; every call copies them out.

    Examples:
        >>> from safe_rl.envs.safety_gym.config import SafetyGymConfig
        >>> from safe_rl.envs.safety_gym.building import build_scene
        >>> physics = BatchPhysics(build_scene(SafetyGymConfig()).model, num_envs=2, num_threads=1)
        >>> physics.step(num_substeps=10).tolist()
        [False, False]
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
    # outputs that are there unless others were asked for
    xpos: Tensor  # [N, nbody, 3] m
    xmat: Tensor  # [N, nbody, 3, 3]
    sensordata: Tensor  # [N, nsensordata]
    subtree_com: Tensor  # [N, nbody, 3] m
    # all outputs that were asked for, by their names in MjData
    outputs: Mapping[str, Tensor]

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        num_threads: int,
        outputs: Sequence[str] = _OUTPUTS,
    ) -> None:
        _log_to_console_only()
        sleeps = bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP)
        has_threads = (num_threads or os.cpu_count() or 1) > 1
        self._process = os.getpid() if has_threads else None
        self._batch = Batch(model, num_envs, num_threads, persistent=sleeps)
        # Every field is bound before the first call: later ones would be zero until the next.
        for name in _STATE:
            setattr(self, name, _share(self._batch.bind(name)))
        sizes = dict(zip(_MEMORY, (model.na, model.nhistory), strict=True))
        remembered = [name for name in _MEMORY if sizes[name]]
        self.memory = {name: _share(self._batch.bind(name)) for name in remembered}
        read = {name: _share(self._batch.bind(name)) for name in outputs}
        if "xmat" in read:
            read["xmat"] = read["xmat"].view(num_envs, model.nbody, 3, 3)
        self.outputs = read
        for name in set(_OUTPUTS).intersection(outputs):
            setattr(self, name, self.outputs[name])
        self._disableflags = self._batch.expand("opt.disableflags")
        self._with_sensors = int(model.opt.disableflags)
        self._warnings = np.zeros_like(self._batch.warning)

    @property
    def timestep(self) -> float:
        """Length of one substep [s]."""
        return float(self._batch.model.opt.timestep)

    def reset(self, mask: Tensor) -> None:
        """Set the simulations in `mask` (bool [N]) to the model's initial state, awake."""
        self._check_process()
        self._batch.reset(mask.numpy(), stage=_NO_STAGE)
        self._warnings[:] = self._batch.warning

    def forward(self, mask: Tensor | None = None, sensors: bool = True) -> None:
        """Bring the outputs up to date with the state, for all simulations or those in `mask`.

        Without `sensors`, the readings and what is computed for them alone stay as they are.
        """
        self._check_process()
        self._disableflags[:] = self._with_sensors | (0 if sensors else _NO_SENSORS)
        self._batch.forward(None if mask is None else mask.numpy())
        self._disableflags[:] = self._with_sensors

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
        self._check_process()
        # Nobody reads sensors between substeps; without them the result is the same to the bit.
        self._disableflags[:] = self._with_sensors | _NO_SENSORS
        if isinstance(num_substeps, int):
            self._substeps(num_substeps, mocap_path, None)
        else:
            for count in num_substeps.unique().tolist():
                self._substeps(count, mocap_path, (num_substeps == count).numpy())
        self._disableflags[:] = self._with_sensors
        if refresh:
            self._batch.forward()
        return self.failed()

    def failed(self) -> Tensor:
        """Return the simulations that failed since the last call of this or `step`, bool [N]."""
        # Their warning counters rose: MuJoCo resets a bad state by itself, silently.
        counts = self._batch.warning
        if np.array_equal(counts, self._warnings):
            return torch.zeros(len(counts), dtype=torch.bool)
        failed = (counts[..., 1] > self._warnings[..., 1]).any(-1)
        counts[failed] = 0  # so that they rise again if these fail again
        self._warnings[:] = counts
        self.ctrl[failed] = 0.0
        return torch.from_numpy(failed)

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
        seen = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
        seen[group] = 1
        distance, _ = self._batch.ray(
            origin.numpy()[:, None], directions.numpy(), geomgroup=seen, bodyexclude=exclude_body
        )
        return torch.from_numpy(distance)

    def _check_process(self) -> None:
        """Raise in a forked process, which has no threads and would wait for them for ever."""
        if self._process is not None and self._process != os.getpid():
            raise RuntimeError(
                "This environment was made before its process was forked, which its threads do "
                "not survive. Make it in the process that steps it, start processes with the "
                "method 'spawn', or give it num_threads=1."
            )

    def _substeps(self, count: int, path: Tensor | None, mask: np.ndarray | None) -> None:
        if count == 0:
            return
        if path is None:
            self._batch.rollout(count, record=(), ids=mask)
            return
        rows = slice(None) if mask is None else torch.from_numpy(mask)
        moved = path[rows, :count].flatten(2)
        control = torch.cat([self.ctrl[rows, None].expand(-1, count, -1), moved], -1)
        self._batch.rollout(count, control.numpy(), _PATH_INPUTS, record=(), ids=mask)
