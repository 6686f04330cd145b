"""N simulations on MuJoCo Warp in float32, on a CUDA device or, slowly, on the CPU."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.physics import ACTUATOR_STATE, OUTPUTS, STATE, BatchPhysics, Physics
from safe_rl.envs.physics import warp_kernels as kernels

_NO_SENSORS = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
_LOST = mjw._src.types.OverflowType
_LOST_CONTACTS = int(_LOST.BROADPHASE | _LOST.NARROWPHASE | _LOST.CCD | _LOST.CONTACT_MATCH)
_LOST_ROWS = int(_LOST.NEFC | _LOST.NJMAX_NNZ)

# Size of the trial that counts contacts.
TRIAL_WORLDS, TRIAL_STEPS = 32, 50
_FEWEST_CONTACTS, _FEWEST_CONSTRAINTS = 32, 128
_NEARLY = 1e-3  # margin of geoms in the trial [m], because contacts on the device differ a little


class BufferOverflowError(RuntimeError):
    """More contacts or constraints than the buffers can hold; some were left out."""


class WarpPhysics(Physics):
    """N simulations of one model on MuJoCo Warp, in float32.

    The first call of a kind records a graph, and later calls replay it: on CUDA one launch for all
    substeps and the forward pass after them. Simulations do not sleep. A forward pass with a mask
    runs for all simulations, which changes nothing in the others.

    On CUDA, the host does not wait for the device: an error of `check`, or an overflow of the
    buffers, is raised by a later call.

    Args:
        model: The compiled model.
        num_envs: Number of simulations, N.
        device: Device of the simulations.
        contacts: Contacts per simulation that the buffer can hold; all simulations share it.
        constraints: Rows of constraints that the buffer of each simulation can hold.
        outputs: Names of the fields of `MjData` that are read.

    Raises:
        NotImplementedError: If the model uses a feature that MuJoCo Warp lacks.
    """

    dtype = torch.float32
    use_graphs = True  # set to False to launch the kernels one by one, for debugging

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        device: torch.device | str,
        contacts: int,
        constraints: int,
        outputs: Sequence[str] = OUTPUTS,
    ) -> None:
        self.device = torch.device(device)
        self.waits = self.device.type == "cuda"
        self.timestep = float(model.opt.timestep)
        wp.config.log_level = wp.LOG_WARNING
        wp.init()
        self._warp_device = wp.device_from_torch(self.device)
        self._rooms = {"contacts": contacts, "constraints": constraints}
        self._graphs: dict[Hashable, wp.Graph] = {}
        self._paths: dict[int, Tensor] = {}
        self._late: list[tuple[Tensor, Any, Callable[[], Exception]]] = []
        with wp.ScopedDevice(self._warp_device):
            self._model = mjw.put_model(model)
            if (model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE).any():
                self._model.callback.contactfilter = _align_capsules
            self._model.opt.warn_overflow = 0  # printed by a kernel; we raise instead
            self._model.opt.contact_sensor_maxmatch = contacts
            # Sensors are not read between substeps.
            self._silent = copy.copy(self._model)
            self._silent.opt = copy.copy(self._model.opt)
            self._silent.opt.disableflags |= _NO_SENSORS
            self._data: Any = mjw.make_data(
                model, num_envs, nconmax=contacts, njmax=constraints, nvmax=None
            )
        self._bind(model)
        self.outputs = {name: wp.to_torch(getattr(self._data, name)) for name in outputs}
        self._lost = wp.to_torch(self._data.overflow)  # a substep sets bits, and none is unset
        self._warm_up()

    def _bind(self, model: mujoco.MjModel) -> None:
        """Share memory with torch, and store the initial state of a simulation."""
        data, num_envs = self._data, self._data.nworld
        shared = {name: wp.to_torch(getattr(data, name)) for name in (*STATE, *ACTUATOR_STATE)}
        for name in STATE:
            setattr(self, name, shared[name])
        sizes = dict(zip(ACTUATOR_STATE, (model.na, model.nhistory), strict=True))
        self.actuator_state = {name: shared[name] for name in ACTUATOR_STATE if sizes[name]}
        initial = [name for name in (*STATE, *ACTUATOR_STATE) if shared[name].numel()]
        flat = {name: shared[name].view(num_envs, -1) for name in initial}
        self._rows: dict[str, Any] = {name: wp.from_torch(values) for name, values in flat.items()}
        self._start = {name: wp.from_torch(values[0].clone()) for name, values in flat.items()}
        self._mask = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self._failed = self._mask.clone()

    def _warm_up(self) -> None:
        """Compile and load all kernels before graphs are recorded, then reset everything."""
        self._mask.fill_(True)
        with self._launching():
            self._substeps(1, None)
            mjw.forward(self._model, self._data)
            self._reset(self._mask)
        # all objects were at one place here, so there were too many contacts
        self._lost.zero_()

    def reset(self, mask: Tensor) -> None:
        """Set the simulations in `mask` to the model's initial state, see `Physics`."""
        self._mask.copy_(mask)
        self._run("reset", self._reset, self._mask)

    def forward(self, mask: Tensor | None = None) -> None:
        """Compute the outputs of all simulations from the state, see `Physics`."""
        self._run("forward", mjw.forward, self._model, self._data)
        self._check_rooms()

    def step(
        self,
        num_substeps: int,
        mocap_path: Tensor | None = None,
        counts: Tensor | None = None,
        refresh: bool = True,
    ) -> Tensor:
        """Advance by substeps and compute the outputs, see `Physics`."""
        assert counts is None  # see `suite.check`
        path = None
        if mocap_path is not None:
            columns = mocap_path.flatten(2)
            if num_substeps not in self._paths:
                self._paths[num_substeps] = torch.empty_like(columns, dtype=self.dtype)
            path = self._paths[num_substeps].copy_(columns)
        key = ("step", num_substeps, path is None, refresh)
        self._run(key, self._step, num_substeps, path, refresh)
        self._check_rooms()
        failed = self._failed.clone()
        self._failed.zero_()
        if not refresh:  # those of failed simulations may not be numbers
            for output in self.outputs.values():
                output.masked_fill_(failed.view(-1, *[1] * (output.ndim - 1)), 0.0)
        return failed

    def check(self, wrong: Tensor, error: Callable[[], Exception]) -> None:
        """Raise an error if `wrong` is True anywhere, now or, on CUDA, in a later call."""
        if not self.waits:
            super().check(wrong, error)
            return
        on_cuda = self.device.type == "cuda"
        seen = torch.empty((), dtype=torch.bool, device="cpu", pin_memory=on_cuda)
        seen.copy_(wrong.any(), non_blocking=True)
        done = torch.cuda.current_stream(self.device).record_event() if on_cuda else None
        self._late.append((seen, done, error))

    def _look(self) -> None:
        """Raise the error of the first earlier check that has arrived and failed."""
        while self._late and (self._late[0][1] is None or self._late[0][1].query()):
            seen, _, error = self._late.pop(0)
            if seen:
                raise error()

    def _check_rooms(self) -> None:
        self._look()
        self.check((self._lost & (_LOST_CONTACTS | _LOST_ROWS)) != 0, self._no_room)

    def _no_room(self) -> BufferOverflowError:
        bits = {"contacts": _LOST_CONTACTS, "constraints": _LOST_ROWS}
        names = [name for name in bits if (self._lost & bits[name]).any()]
        room = " and ".join(f"{self._rooms[name]} {name}" for name in names)
        return BufferOverflowError(
            f"There is room for {room} per environment, but there were more; some were left out. "
            "Raise env.physics_buffers."
        )

    @contextmanager
    def _launching(self) -> Iterator[None]:
        """Launch on torch's present stream."""
        with wp.ScopedDevice(self._warp_device):
            if self.device.type != "cuda":
                yield
                return
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
            with wp.ScopedStream(stream, sync_enter=False):
                yield

    def _run(self, key: Hashable, body: Callable[..., None], *arguments: Any) -> None:
        """Launch kernels by a graph, which the first call with a key records."""
        if not self.use_graphs:
            with self._launching():
                body(*arguments)
            return
        if key not in self._graphs:
            with wp.ScopedDevice(self._warp_device), wp.ScopedCapture() as capture:
                body(*arguments)
            self._graphs[key] = capture.graph
        with self._launching():
            wp.capture_launch(self._graphs[key])

    def _step(self, num_substeps: int, path: Tensor | None, refresh: bool) -> None:
        self._substeps(num_substeps, path)
        if not refresh and "cfrc_ext" in self.outputs:
            mjw.rne_postconstraint(self._model, self._data)
        failed = [wp.from_torch(self._failed)]
        for name in ("qpos", "qvel", "qacc_warmstart"):
            if name in self._rows:
                row = self._rows[name]
                wp.launch(kernels.find_failures, row.shape, [row, mujoco.mjMAXVAL], failed)
        self._reset(self._failed)
        if refresh:
            mjw.forward(self._model, self._data)

    def _substeps(self, num_substeps: int, path: Tensor | None) -> None:
        for substep in range(num_substeps):
            if path is not None:
                live = self._rows["mocap_pos"]
                wp.launch(kernels.follow_path, live.shape, [wp.from_torch(path), substep], [live])
            mjw.step(self._silent, self._data)

    def _reset(self, mask: Tensor) -> None:
        chosen = wp.from_torch(mask)
        for name, live in self._rows.items():
            wp.launch(kernels.reset_rows, live.shape, [chosen, self._start[name]], [live])


def _align_capsules(model: Any, data: Any) -> None:
    """Give contacts of capsules on planes the same frames as MuJoCo."""
    inputs = [data.nacon, model.geom_type, data.contact.geom, data.contact.worldid, data.geom_xmat]
    wp.launch(kernels.align_capsules, data.naconmax, inputs, [data.contact.frame])


def make_warp_physics(env: Any, model: mujoco.MjModel, outputs: Sequence[str]) -> Physics:
    """Build the physics for the value "warp" of the key `physics`.

    Args:
        env: The environment; another one of its family makes a trial on the CPU.
        model: Its compiled world.
        outputs: Names of the fields of `MjData` that are read.

    Raises:
        ConfigError: If MuJoCo Warp does not support the robot, or for an unsupported device.
    """
    config, device, num_envs = env.config, env.device, env.batch_size[0]
    if device.type not in ("cpu", "cuda"):
        raise ConfigError(f"'physics' warp runs on the devices cpu and cuda, got {device}.")
    # a class of the user's may have another constructor
    family: Any = next(c for c in type(env).__mro__ if c.__module__.startswith("safe_rl."))
    most, scale = most_contacts(config, family), config.physics_buffers
    contacts = _power_of_two(max(scale * most[0], _FEWEST_CONTACTS))
    constraints = _power_of_two(max(scale * most[1], _FEWEST_CONSTRAINTS))
    try:
        return WarpPhysics(model, num_envs, device, contacts, constraints, outputs)
    except (NotImplementedError, ValueError) as error:
        raise ConfigError(
            f"'physics' warp does not support the robot of this environment: {error} Use "
            "'physics' cpu."
        ) from error


@functools.lru_cache(maxsize=64)
def most_contacts(config: Any, env_class: Any) -> tuple[int, int]:
    """Return the most contacts and constraint rows of a world in a trial of random actions."""

    class Trial(env_class):
        def _make_physics(
            self, model: mujoco.MjModel, bodies: slice, num_threads: int, outputs: Any = OUTPUTS
        ) -> Physics:
            model = copy.copy(model)
            model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
            model.geom_margin[:] += _NEARLY
            counted = (*outputs, "ncon", "nefc")
            return BatchPhysics(model, self.batch_size[0], num_threads, counted)

    env = Trial(config.replace(physics="cpu"), TRIAL_WORLDS, seed=0)
    env._begin(torch.ones(TRIAL_WORLDS, dtype=torch.bool))
    generator = torch.Generator().manual_seed(0)
    counts = [env._physics.outputs[name] for name in ("ncon", "nefc")]
    highest = [int(count.max()) for count in counts]
    low, high = env.action_spec.space.low, env.action_spec.space.high
    for _ in range(TRIAL_STEPS):
        env._advance(low + (high - low) * torch.rand(low.shape, generator=generator))
        highest = [max(most, int(count.max())) for most, count in zip(highest, counts, strict=True)]
    return highest[0], highest[1]


def _power_of_two(number: float) -> int:
    """Round up to a power of two, because kernels are compiled once for each size."""
    return 1 << (math.ceil(number) - 1).bit_length()
