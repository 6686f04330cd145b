"""A batched simulated environment as arrays: the common part of Gymnasium's two interfaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Dict
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, TensorSpec

from safe_rl.envs.keys import COST, ConfigError
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.env import SafetyGymEnv
from safe_rl.envs.safety_gym.suite import resolve
from safe_rl.envs.simulated import SimulatedEnv
from safe_rl.envs.velocity.velocity_config import (
    VELOCITY_SUITE,
    VelocityConfig,
    resolve_velocity,
    velocity_name,
)
from safe_rl.envs.velocity.velocity_env import VelocityEnv

EPISODE_COST = "episode_cost"  # sum over the steps of the episode so far
NUM_SEEDS = 2**62
RENDER_MODES = ["rgb_array"]
# what people give to `gymnasium.make` that neither it nor a configuration takes
_ELSEWHERE = {"seed": "use reset(seed=…)", "num_envs": "use gymnasium.make_vec"}

Observation = np.ndarray | dict[str, np.ndarray]
Config = Mapping[str, Any] | SafetyGymConfig | VelocityConfig | None


class Worlds:
    """A batched environment as arrays: the common part of both interfaces.

    The environment's spec gives the length of episodes, for wrappers and tools that read it. The
    registered spec does not, because Gymnasium would add a second time limit.

    Attributes:
        batch: The batched environment inside.
    """

    batch: SimulatedEnv
    _spec: EnvSpec | None = None
    _is_seeded = False

    def _open(
        self,
        name: str | None,
        config: Config,
        num_envs: int,
        num_threads: int,
        num_steps: int | None,
        /,
        *,
        render_mode: str | None = None,
        camera: Any = None,
        width: int = 480,
        height: int = 360,
        sleep: bool = True,
        positions: bool = False,
        **unknown: Any,
    ) -> None:
        if unknown:
            key = next(iter(unknown))
            other = f"put keys of the configuration into config={{'{key}': …}}"
            # TorchRL's `GymEnv` tries an argument `frameskip`, and looks for these words
            raise TypeError(
                f"{type(self).__name__} got an unexpected keyword argument '{key}': "
                f"{_ELSEWHERE.get(key, other)}."
            )
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(f"render_mode must be one of {RENDER_MODES}, got {render_mode!r}.")
        self.batch = batch_of(name, config, num_envs, num_threads, num_steps, sleep)
        self.render_mode, self._has_positions = render_mode, positions
        self._view: dict[str, Any] = {"camera": camera, "width": width, "height": height}
        self._episode_cost = np.zeros(self.batch.batch_size.numel())  # since the last reset
        rate = max(1, round(1 / self.batch.seconds_per_step))  # of real time
        self.metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": rate}

    @property
    def spec(self) -> EnvSpec | None:
        """The registered spec, with the configuration's `num_steps` as `max_episode_steps`."""
        return self._spec and replace(self._spec, max_episode_steps=self.batch.max_episode_steps)

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec

    def spaces(self) -> tuple[gymnasium.Space, Box]:
        """Spaces of one environment's observation (by name if it is nested) and action."""
        seen = self.batch.observation_spec["observation"]
        ends = self.batch.action_spec.space
        actions = Box(ends.low[0].cpu().numpy(), ends.high[0].cpu().numpy(), dtype=np.float32)
        if isinstance(seen, Composite):
            return Dict({name: _any_numbers(part) for name, part in seen.items()}), actions
        return _any_numbers(seen), actions

    def _seed(self, seed: Any, generator: np.random.Generator) -> None:
        """Seed all later episodes; without a seed, the first call draws one."""
        seed = seed.tolist() if isinstance(seed, np.ndarray) else seed
        if isinstance(seed, str) or not isinstance(seed, int | np.integer | Sequence | None):
            raise TypeError(f"A seed is an integer, or a sequence of one per row, got {seed!r}.")
        if isinstance(seed, int | np.integer):
            self.batch.set_seed(int(seed) % NUM_SEEDS)
        elif not self._is_seeded:
            self.batch.set_seed(int(generator.integers(NUM_SEEDS)))
        if isinstance(seed, Sequence):
            self.batch.set_row_seeds([None if s is None else s % NUM_SEEDS for s in seed])
        self._is_seeded = True

    def _reset(self, mask: np.ndarray | None = None) -> Observation:
        """Start episodes in all rows or in those of a mask [N]; return the observation of all."""
        ask = None
        if mask is not None:
            ask = TensorDict({"_reset": torch.from_numpy(mask).unsqueeze(-1)}, len(mask))
        self._episode_cost[slice(None) if mask is None else mask] = 0.0
        # TorchRL's `reset` would return zeros for the other rows
        return arrays_of(self.batch._reset(ask)["observation"])

    def _step(
        self, actions: np.ndarray
    ) -> tuple[Observation, tuple[Any, Any, Any], dict[str, Any]]:
        """Take a step; return observation, (reward, terminated, truncated) [N] each, and infos."""
        action = torch.as_tensor(actions, dtype=torch.float32, device=self.batch.device)
        step = self.batch.step(TensorDict({"action": action}, self.batch.batch_size))["next"]
        names = ("reward", "terminated", "truncated", *self.batch.cost_keys, *self.batch.events)
        column = {name: step[name].squeeze(-1).cpu().numpy() for name in names}
        infos = {key: column[key].astype(np.float64) for key in self.batch.cost_keys}
        infos |= {key: column[key] for key in self.batch.events}
        self._episode_cost += infos[COST]
        # at every step, because wrappers such as `TimeLimit` may end the episode after any of them
        infos[EPISODE_COST] = self._episode_cost.copy()
        values = (column["reward"].astype(np.float64), column["terminated"], column["truncated"])
        return arrays_of(step["observation"]), values, infos

    def _positions(self) -> dict[str, Any]:
        """Present positions by kind [N, K, 3] (m) under `positions`; empty if not wanted."""
        return {"positions": arrays_of(self.batch.get_positions())} if self._has_positions else {}


def _any_numbers(spec: TensorSpec) -> Box:
    return Box(-np.inf, np.inf, spec.shape[1:], np.float32)


def batch_of(
    name: str | None,
    config: Config,
    num_envs: int,
    num_threads: int,
    num_steps: int | None,
    sleep: bool,
) -> SimulatedEnv:
    """Make the environments of a name with some keys changed, or of a whole configuration."""
    if isinstance(config, str):
        raise ConfigError(f"config='{config}' is a name: give keys, as make_env('{config}').config")
    base: Any = SafetyGymConfig()
    if name is not None:
        base = resolve_velocity(name) if velocity_name(name) in VELOCITY_SUITE else resolve(name)
    if config is None or isinstance(config, Mapping):
        whole = base.replace(**(config or {}))
    elif isinstance(config, type(base)):
        whole = config
    else:
        raise ConfigError(
            f"'config' of {name} must be a mapping of keys to change, or a {type(base).__name__}; "
            f"got a {type(config).__name__}."
        )
    if num_steps is not None:
        whole = whole.replace(num_steps=num_steps)
    if isinstance(whole, SafetyGymConfig):
        return SafetyGymEnv(whole, num_envs, "cpu", 0, num_threads, sleep)
    return VelocityEnv(whole, num_envs, "cpu", 0, num_threads)


def arrays_of(observation: torch.Tensor | TensorDictBase) -> Observation:
    """Observation of N environments as arrays, by name if it is nested."""
    if isinstance(observation, TensorDictBase):
        return {str(key): value.cpu().numpy() for key, value in observation.items()}
    return observation.cpu().numpy()


def take(observation: Observation, row: int) -> Observation:
    """Observation of one environment."""
    if isinstance(observation, dict):
        return {key: value[row] for key, value in observation.items()}
    return observation[row]


def choose(mask: np.ndarray, chosen: Any, other: Any) -> Any:
    """Rows of `chosen` where the mask [N] is True, of `other` elsewhere."""
    if isinstance(other, dict):
        return {key: choose(mask, chosen[key], other[key]) for key in other}
    return np.where(mask.reshape(-1, *[1] * (other.ndim - 1)), chosen, other)


def with_masks(infos: Mapping[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Set every array [N, …] to 0 outside the mask [N], and add the mask as `_<key>`."""
    masked = {
        key: with_masks(values, mask)
        if isinstance(values, dict)
        else choose(mask, values, np.zeros_like(values))
        for key, values in infos.items()
    }
    return masked | {f"_{key}": mask.copy() for key in infos}


def final_infos(
    observation: Observation, infos: Mapping[str, Any], ends: np.ndarray
) -> dict[str, Any]:
    """Describe the episodes that ended [N], as Gymnasium does in the mode that resets at once."""
    if not ends.any():
        return {}
    observations = np.full(len(ends), None, dtype=object)
    for row in np.flatnonzero(ends).tolist():
        observations[row] = take(observation, row)
    return {
        "final_obs": observations,
        "_final_obs": ends.copy(),
        "final_info": with_masks(infos, ends),
        "_final_info": ends.copy(),
    }
