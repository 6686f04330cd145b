"""Base class of environments that run the simulation themselves: seeds, states, pictures."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from safe_rl.envs import rng
from safe_rl.envs.contract import ConstrainedEnv
from safe_rl.envs.keys import ConfigError, Count, Seed, Threads, check_key
from safe_rl.envs.physics import OUTPUTS, BatchPhysics, Physics
from safe_rl.envs.physics.dynamics import SCALES, DrawnDynamics
from safe_rl.envs.pictures import chosen_rows
from safe_rl.extras import require_extra


class SimulatedEnv(ConstrainedEnv):
    """N simulated worlds: seeds, episodes and states, for any family.

    The class of a family builds the physics, observer and renderer, and implements how episodes
    begin, how worlds are stepped, and how their state is read and written.

    Args:
        num_envs: Number of worlds, N.
        device: Device of the TensorDicts.
        num_threads: Threads that step the physics; 0 for one per core.
    """

    reuses_tensors = False
    steps_after_end = True
    #: Flags of a step, all of them False after a reset.
    flags: ClassVar[tuple[str, ...]] = ("done", "terminated", "truncated")
    #: Default camera of pictures.
    first_camera: ClassVar[str]
    #: Keys that may be missing in a state that is set.
    optional: ClassVar[tuple[str, ...]] = ("seed", "episode", "dynamics")

    #: Simulated time of a step [s].
    seconds_per_step: float
    #: Whether every world has begun an episode; from then on this stays True.
    _all_begun = False
    #: Draws factors on the dynamics for every episode, if the configuration has a range of them.
    _dynamics: DrawnDynamics | None = None
    config: Any
    #: Draws the worlds, with `frames` as in `WorldRenderer`; a cached property.
    _renderer: Any
    cost_keys: list[str]
    _physics: Physics
    _observer: Any

    def __init__(self, num_envs: int, device: torch.device | str, num_threads: int) -> None:
        num_envs = check_key("num_envs", Count, num_envs)
        check_key("num_threads", Threads, num_threads)
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))

    def _make_physics(
        self,
        model: mujoco.MjModel,
        bodies: slice,
        num_threads: int,
        outputs: Sequence[str] = OUTPUTS,
    ) -> Physics:
        """Build the physics; `bodies` are the ids of the robot's bodies."""
        scales = {key: getattr(self.config, key) for key in SCALES}
        ranges = {key: value for key, value in scales.items() if isinstance(value, tuple)}
        if self.config.physics == "cpu":
            physics = BatchPhysics(model, self.batch_size[0], num_threads, outputs)
            if ranges:
                self._dynamics = DrawnDynamics(model, physics.batch, ranges, bodies)
            return physics
        if ranges:  # before the physics, which takes seconds to build
            raise ConfigError(
                f"'{next(iter(ranges))}' is a range, which 'physics' warp does not have: use "
                "'physics' cpu, or one factor."
            )
        require_extra("mujoco_warp", extra="gpu")
        from safe_rl.envs.physics.warp_physics import make_warp_physics

        return make_warp_physics(self, model, outputs)

    def _announce(
        self, model: mujoco.MjModel, observation: TensorSpec, highest: float, seed: int | None
    ) -> None:
        """Set the specs and the first seed, after everything else is built.

        The largest cost of a step is ``highest``. Without a seed, torch's generator gives one.
        """
        physics = self._physics
        self._episode = torch.zeros(self.batch_size, dtype=torch.int64, device=physics.device)
        self._row_seed = torch.zeros_like(self._episode)
        self._has_cost = torch.zeros_like(self._episode, dtype=torch.bool)
        self._begun, self._ended = self._has_cost.clone(), self._has_cost.clone()
        low, high = torch.from_numpy(model.actuator_ctrlrange.T.copy())
        self._control_range = (low.to(physics.ctrl), high.to(physics.ctrl))
        self.max_episode_steps = self.config.num_steps
        self.observation_layout = dict(self._observer.columns)
        batch, scalar = self.batch_size, (*self.batch_size, 1)
        kind: dict[str, Any] = {"dtype": torch.float32, "device": self.device}
        flag = Binary(1, shape=scalar, dtype=torch.bool, device=self.device)
        ends = {name: flag.clone() for name in SimulatedEnv.flags}
        events = {name: flag.clone() for name in self.flags if name not in ends}
        costs = {key: Bounded(0.0, highest, shape=scalar, **kind) for key in self.cost_keys}
        low, high = (bound.to(torch.float32).expand(*batch, -1) for bound in (low, high))
        if self.privileged_layout:
            size = max(columns.stop for columns in self.privileged_layout.values())
            events["privileged"] = Unbounded(shape=(*batch, size), **kind)
        self.observation_spec = Composite(observation=observation, **events, shape=batch)
        self.action_spec = Bounded(low, high, **kind)
        self.reward_spec = Composite(reward=Unbounded(shape=scalar, **kind), **costs, shape=batch)
        self.done_spec = Composite(**ends, shape=batch)
        self.set_seed(int(torch.randint(2**62, ())) if seed is None else seed)

    def set_row_seeds(self, seeds: Sequence[int | None]) -> None:
        """Seed every world separately, [N]: it gets the episodes of row 0 of an environment.

        None keeps the seed of a world.

        Raises:
            ValueError: If there are not as many seeds as worlds.
        """
        if len(seeds) != self.batch_size[0]:
            raise ValueError(f"There must be {self.batch_size[0]} seeds, got {len(seeds)}.")
        for row, seed in enumerate(seeds):
            self._set_seed(seed, slice(row, row + 1))

    def _set_seed(self, seed: int | None, rows: slice = slice(None)) -> None:
        if seed is not None:
            seed = check_key("seed", Seed, seed)
            number = len(self._episode[rows])
            self._row_seed[rows] = rng.row_seeds(seed, number, self._physics.device)
            self._episode[rows] = 0

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **others: Any) -> TensorDictBase:
        if others:
            raise TypeError(f"reset takes no {', '.join(others)}; call env.set_seed(…) before it.")
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones_like(self._begun)
        mask = mask.reshape(self.batch_size).to(self._physics.device)
        self._episode += mask
        if self._dynamics is not None:
            self._dynamics.draw(rng.fold(self._row_seed, self._episode), mask)
        self._begin(mask)
        self._has_cost &= ~mask
        self._ended &= ~mask
        self._begun |= mask
        self._all_begun = self._all_begun or bool(self._begun.all())
        return self._output(self._begun.new_zeros(len(self.flags), len(self._begun)))

    def _output(self, flags: Tensor, numbers: Tensor | None = None) -> TensorDict:
        """Return the output of a reset or step: flags [F, N], and reward and costs [1 + K, N]."""
        outputs: dict[str, Any] = dict(zip(self.flags, flags.unsqueeze(-1), strict=True))
        self._ended |= flags[self.flags.index("done")]
        if numbers is not None:
            names = ("reward", *self.cost_keys)
            outputs |= zip(names, numbers.to(torch.float32).unsqueeze(-1), strict=True)
        if self.device != self._physics.device:
            outputs = {key: value.to(self.device) for key, value in outputs.items()}
        outputs["observation"] = self._observe()
        if self.privileged_layout:
            outputs["privileged"] = self._observe_privileged()
        # TorchRL's own environments do this too: shapes and devices are right by construction.
        return TensorDict._new_unsafe(outputs, batch_size=self.batch_size, device=self.device)

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """Skip TorchRL's checks of every step: shapes and end flags are right by construction."""
        return next_tensordict_out

    def _checked_action(self, tensordict: TensorDictBase) -> Tensor:
        stepped = tensordict.get("_step", None)
        # TorchRL leaves out what a world does after its episode, whether it is stepped or not
        if stepped is not None and not (stepped.reshape(self.batch_size) | self._ended).all():
            raise NotImplementedError(
                "A transform of TorchRL, such as ConditionalSkip or MultiAction, asks for a step "
                "of some worlds only ('_step'), but all worlds are stepped together. Use "
                "num_envs=1; to hold actions, use ActionRepeat of safe_rl.envs.transforms."
            )
        action, needed = tensordict["action"], self._physics.ctrl.shape
        if action.shape != needed or not action.dtype.is_floating_point:
            raise ValueError(
                f"'action' must be a floating-point tensor of shape {tuple(needed)} (num_envs, "
                f"number of actuators), got {action.dtype} {tuple(action.shape)}."
            )
        if not self._all_begun:
            rows = (~self._begun).nonzero()[:, 0].tolist()
            which = f" of rows {rows}" if self._begun.any() else ""
            raise RuntimeError(f"No episode has begun{which}: call reset() before a step.")
        return action.detach().to(self._physics.device)

    @abstractmethod
    def _begin(self, mask: Tensor) -> None:
        """Begin the episodes `_episode` in the worlds of a mask, bool [N]."""

    @abstractmethod
    def _advance(self, action: Tensor) -> Tensor:
        """Run the substeps of one step; return the worlds whose physics failed, bool [N]."""

    @abstractmethod
    def _observe(self) -> Tensor | TensorDict:
        """Return the observation on the device; later steps do not change it."""

    def _observe_privileged(self) -> Tensor:
        """Return the entry `privileged` on the device, if `privileged_layout` has columns."""
        raise NotImplementedError

    @abstractmethod
    def _read_state(self) -> TensorDict:
        """Return a copy of the state of the worlds, without seeds."""

    @abstractmethod
    def _write_state(self, state: TensorDictBase) -> None:
        """Set the worlds to a state whose keys, shapes and types are right."""

    def get_state(self) -> TensorDict:
        """Return a copy of the state, a TensorDict [N]: it determines all later steps and draws."""
        state = self._read_state()
        state["seed"], state["episode"] = self._row_seed.clone(), self._episode.clone()
        if self._dynamics is not None:
            state["dynamics"] = self._dynamics.factors.clone()
        return state

    @torch.no_grad()
    def set_state(self, state: TensorDictBase) -> TensorDict:
        """Set the worlds to a state, for resuming and tests; return the output of a reset.

        Args:
            state: TensorDict [N] from `get_state`. Without seeds, the present seeds remain.

        Raises:
            KeyError: If a key is missing.
            ValueError: If a shape, a type or a value does not fit.
        """
        self._check_state(state)
        if self._dynamics is not None and "dynamics" in state:
            self._dynamics.set(state["dynamics"], torch.ones_like(self._begun))
        self._write_state(state)
        self._row_seed = state.get("seed", self._row_seed).clone()
        self._episode = state.get("episode", self._episode).clone()
        self._has_cost.zero_()
        self._ended.zero_()
        self._begun.fill_(True)
        self._all_begun = True
        return self._output(self._begun.new_zeros(len(self.flags), len(self._begun)))

    def _check_state(self, state: TensorDictBase) -> None:
        expected = self.get_state()
        for key, value in expected.items():
            if key not in state:
                if key in self.optional:
                    continue
                needed = sorted(set(expected.keys()) - set(self.optional))
                raise KeyError(f"The state lacks '{key}'; it needs {needed}.")
            given = state[key]
            if given.shape != value.shape:
                raise ValueError(
                    f"State '{key}' must have shape {tuple(value.shape)} in this environment, got "
                    f"{tuple(given.shape)}."
                )
            if not value.dtype.is_floating_point and given.dtype != value.dtype:
                raise ValueError(f"State '{key}' must be {value.dtype}, got {given.dtype}.")

    def render(
        self,
        rows: int | Sequence[int] | None = None,
        *,
        camera: str | mujoco.MjvCamera | None = None,
        width: int = 480,
        height: int = 360,
    ) -> np.ndarray:
        """Draw the present worlds, with a red sphere where the last step had a cost.

        Args:
            rows: Indices of the worlds; None draws all of them.
            camera: Name from the docstring of the class, or a `mujoco.MjvCamera`; None is the first
                of the names.
            width: Width of a frame [pixels].
            height: Height of a frame [pixels].

        Returns:
            RGB, uint8: one frame [height, width, 3] for an integer, else [R, height, width, 3].

        Raises:
            OpenGLError: If OpenGL is missing; the message names the package to install.
            ValueError: For an unknown camera, or a frame without pixels or with too many.
        """
        if min(width, height) < 1:
            raise ValueError(f"A frame needs at least one pixel, got {width} x {height}.")
        chosen, is_one = chosen_rows(rows, self.batch_size[0])
        camera = self.first_camera if camera is None else camera
        frames = self._renderer.frames(chosen, self._has_cost, camera, width, height)
        return frames[0] if is_one else frames

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the resources of OpenGL."""
        if "_renderer" in vars(self):  # it is made for the first picture
            self._renderer.close()
        super().close(raise_if_closed=raise_if_closed)
