"""What environments that simulate their worlds here have in common, whatever is simulated."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase

from safe_rl.envs import rng
from safe_rl.envs.errors import require_integer
from safe_rl.envs.physics.cpu import BatchPhysics


class Specs(NamedTuple):
    """What `EnvBase` asks for, for N worlds."""

    observation: Composite
    action: TensorSpec
    reward: Composite
    done: Composite


class SimulatedEnv(EnvBase):
    """N worlds on a thread pool: seeds, episodes, states and copies, of any family.

    A family builds its physics, observer and renderer, and says how a world is begun, stepped,
    read and written.

    Args:
        num_envs: number of worlds, N.
        device: where the TensorDicts live; the physics runs on the CPU.
        num_threads: threads that step the physics; 0 for one per core.
    """

    #: Flags that are written beside the numbers, all of them False after a reset.
    flags: ClassVar[tuple[str, ...]] = ("done", "terminated", "truncated")
    #: What a copy has beside the state: attributes that are tensors.
    copied: ClassVar[tuple[str, ...]] = ("_row_seed", "_has_cost", "_begun")

    config: Any
    _physics: BatchPhysics
    _observer: Any
    _renderer: Any

    def __init__(self, num_envs: int, device: torch.device | str, num_threads: int) -> None:
        require_integer("num_envs", num_envs, lowest=1)
        require_integer("num_threads", num_threads, lowest=0)
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self._episode = torch.zeros(num_envs, dtype=torch.int64)
        self._has_cost = torch.zeros(num_envs, dtype=torch.bool)
        self._begun = torch.zeros(num_envs, dtype=torch.bool)
        self._physics_settings: tuple[Any, ...] = (num_threads,)

    def _announce(self, specs: Specs, seed: int | None) -> None:
        """Take the specs and the first seed, when everything else is built."""
        self.observation_spec, self.action_spec = specs.observation, specs.action
        self.reward_spec, self.done_spec = specs.reward, specs.done
        self.set_seed(int(torch.randint(2**62, ())) if seed is None else seed)

    @property
    def max_episode_steps(self) -> int:
        """Steps after which an episode is truncated."""
        return self.config.num_steps

    @property
    def observation_layout(self) -> dict[str, slice]:
        """Columns of every named component in `observation`."""
        return dict(self._observer.columns)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            return
        require_integer("seed", seed, lowest=-(2**63))
        self._row_seed = rng.row_seeds(seed, self.batch_size[0])
        self._episode.zero_()

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones(self.batch_size, dtype=torch.bool)
        mask = mask.reshape(self.batch_size).cpu()
        self._episode += mask
        self._begin(mask)
        self._has_cost &= ~mask
        self._begun |= mask
        return self._reset_output()

    def _reset_output(self) -> TensorDict:
        """What a reset returns, for the worlds as they are."""
        none = torch.zeros(len(self.flags), *self.batch_size, 1, dtype=torch.bool)
        return self._pack(dict(zip(self.flags, none, strict=True)))

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """Skip TorchRL's checks of every step: shapes and end flags are right by construction."""
        return next_tensordict_out

    def _checked_action(self, tensordict: TensorDictBase) -> Tensor:
        action, needed = tensordict.get("action"), self._physics.ctrl.shape
        if action.shape != needed or not action.dtype.is_floating_point:
            raise ValueError(
                f"'action' must be a floating-point tensor of shape {tuple(needed)} (num_envs, "
                f"number of actuators), got {action.dtype} {tuple(action.shape)}."
            )
        return action.detach().cpu()

    @abstractmethod
    def _begin(self, mask: Tensor) -> None:
        """Begin the episodes `_episode` in worlds of a mask, bool [N]."""

    @abstractmethod
    def _pack(self, outputs: dict[str, Any]) -> TensorDict:
        """Add the observation and move everything to the device."""

    @abstractmethod
    def _read_state(self) -> TensorDict:
        """Copy what the worlds are in, without seeds."""

    @abstractmethod
    def _write_state(self, state: TensorDictBase) -> None:
        """Check a state, and put the worlds into it."""

    def get_state(self) -> TensorDict:
        """Return a copy of everything that determines what happens next.

        Returns:
            TensorDict [N] with what the class says of states, and the seeds: `seed`, `episode`.
        """
        state = self._read_state()
        state["seed"], state["episode"] = self._row_seed.clone(), self._episode.clone()
        return state

    @torch.no_grad()
    def set_state(self, state: TensorDictBase) -> TensorDict:
        """Set the worlds to a state, for resuming, branching and tests.

        Args:
            state: TensorDict [N] as `get_state` returns it; without seeds the present ones stay.

        Returns:
            What a reset returns, for that state.

        Raises:
            KeyError: if a key is missing.
            ValueError: if a shape, a type or a value does not fit.
        """
        self._write_state(state)
        self._row_seed = state.get("seed", self._row_seed).clone()
        self._episode = state.get("episode", self._episode).clone()
        self._has_cost.zero_()
        self._begun.fill_(True)
        return self._reset_output()

    def __reduce__(self) -> tuple[Any, ...]:
        """Tell `copy` and `pickle` to build anew and set the state, as far as `set_state` does."""
        settings = (self.config, self.batch_size[0], self.device, 0, *self._physics_settings)
        tensors = {name: getattr(self, name).clone() for name in self.copied}
        return type(self), settings, (self.get_state(), tensors)

    def __setstate__(self, kept: tuple[TensorDict, Mapping[str, Tensor]]) -> None:
        state, tensors = kept
        if tensors["_begun"].any():  # else there are seeds, and nothing else
            self.set_state(state)
        for name, tensor in tensors.items():
            setattr(self, name, tensor)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free what OpenGL holds, and close the viewer if there is one."""
        self._renderer.close()
        super().close(raise_if_closed=raise_if_closed)
