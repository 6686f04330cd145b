"""What Gymnasium's two interfaces have in common: spaces, arrays, infos, and when to show."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite

from safe_rl.envs.opengl import OpenGLError, has_screen
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.env import SafetyGymEnv
from safe_rl.envs.safety_gym.suite import resolve

RENDER_MODES = ("human", "rgb_array")
NUM_SEEDS = 2**62

Observation = np.ndarray | dict[str, np.ndarray]
Seeds = int | Sequence[int | None] | np.ndarray | None
Arrays = dict[str, np.ndarray]


def configure(
    name: str | None, config: Mapping[str, Any] | SafetyGymConfig | None
) -> SafetyGymConfig:
    """Return the configuration of a registered name, with some keys changed.

    Args:
        name: as `resolve` takes it; None starts from the defaults of every key.
        config: keys to change, or a whole configuration, which takes the place of the named one.

    Raises:
        ConfigError: for an unknown name or key, or a value that cannot be used.
    """
    if isinstance(config, SafetyGymConfig):
        return config
    base = SafetyGymConfig() if name is None else resolve(name)
    return base.replace(**(config or {}))


def action_space(env: SafetyGymEnv) -> gymnasium.spaces.Box:
    """Return the actions of one world."""
    low, high = env.action_spec.space.low, env.action_spec.space.high
    return gymnasium.spaces.Box(low[0].cpu().numpy(), high[0].cpu().numpy(), dtype=np.float32)


def observation_space(env: SafetyGymEnv) -> gymnasium.Space:
    """Return what one world observes: flat, or by name where it is nested."""
    spec, bounds = env.observation_spec["observation"], env.observation_bounds
    if isinstance(spec, Composite):
        return gymnasium.spaces.Dict(
            {
                name: gymnasium.spaces.Box(*bounds[name], part.shape[1:], np.float32)
                for name, part in spec.items()
            }
        )
    low, high = np.empty((2, spec.shape[-1]), np.float32)
    for name, columns in env.observation_layout.items():
        low[columns], high[columns] = bounds[name]
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


class SpecWithLength:
    """An environment whose spec says how long episodes are, for wrappers and tools that ask it.

    The registered one does not: Gymnasium would add a time-out of its own to the environment's,
    and it would stand where a configuration has another `num_steps`.
    """

    _spec: EnvSpec | None = None
    _num_steps: int

    @property
    def spec(self) -> EnvSpec | None:
        """What it was made from; `max_episode_steps` is the configuration's `num_steps`."""
        return self._spec and replace(self._spec, max_episode_steps=self._num_steps)

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec


def arrays_of(observation: torch.Tensor | TensorDictBase) -> Observation:
    """Return an observation of N worlds as arrays, by name where it is nested."""
    if isinstance(observation, TensorDictBase):
        return {str(key): value.cpu().numpy() for key, value in observation.items()}
    return observation.cpu().numpy()


def take(observation: Observation, row: int) -> Observation:
    """Return one world's observation."""
    if isinstance(observation, dict):
        return {key: value[row] for key, value in observation.items()}
    return observation[row]


class Worlds:
    """A batched environment as arrays, and how it is shown.

    Args:
        config: of the environment.
        num_envs: number of worlds, N.
        num_threads: as `SafetyGymEnv` takes it.
        sleep: as `SafetyGymEnv` takes it.
        render_mode: one of `RENDER_MODES`, or None.
        with_positions: whether there are `positions` among the infos.

    Raises:
        ValueError: for another render mode.
        OpenGLError: for the mode "human" where there is no screen.
    """

    def __init__(
        self,
        config: SafetyGymConfig,
        num_envs: int,
        num_threads: int,
        sleep: bool,
        render_mode: str | None,
        with_positions: bool,
    ) -> None:
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(f"render_mode must be one of {RENDER_MODES}, got {render_mode!r}.")
        if render_mode == "human" and not has_screen():
            raise OpenGLError(
                "render_mode='human' opens a window, and there is no screen here (neither DISPLAY "
                "nor WAYLAND_DISPLAY is set). Use render_mode='rgb_array', which needs none."
            )
        self.env = SafetyGymEnv(config, num_envs, "cpu", 0, num_threads, sleep)
        self.observation_space = observation_space(self.env)
        self.action_space = action_space(self.env)
        self.seconds_per_step = self.env.seconds_per_step
        self._with_positions = with_positions
        self._is_shown = render_mode == "human"
        self._is_seeded = False
        self._shown_at = 0.0

    def metadata(self) -> dict[str, Any]:
        """Render modes that work on this machine, and frames per second of real time."""
        modes = [mode for mode in RENDER_MODES if mode != "human" or has_screen()]
        return {"render_modes": modes, "render_fps": max(1, round(1 / self.seconds_per_step))}

    def seed(self, seed: Seeds, generator: np.random.Generator) -> None:
        """Seed all episodes to come; without a seed, once, with one that is drawn.

        Raises:
            TypeError: for what is neither a seed nor a sequence of seeds.
            ValueError: for a sequence with another length than the number of worlds.
        """
        if isinstance(seed, np.ndarray):
            seed = seed.tolist()
        if isinstance(seed, str) or not isinstance(seed, int | np.integer | Sequence | None):
            raise TypeError(f"A seed is an integer, or one for every world, got {seed!r}.")
        if isinstance(seed, int | np.integer):
            self.env.set_seed(int(seed) % NUM_SEEDS)
        elif not self._is_seeded:
            self.env.set_seed(int(generator.integers(NUM_SEEDS)))
        if isinstance(seed, Sequence):
            self.env.set_row_seeds([None if s is None else s % NUM_SEEDS for s in seed])
        self._is_seeded = True

    def reset(self, mask: np.ndarray | None = None) -> Observation:
        """Start new episodes, everywhere or where the mask [N] says; all worlds' observation."""
        ask = None
        if mask is not None:
            ask = TensorDict({"_reset": torch.from_numpy(mask).unsqueeze(-1)}, len(mask))
        return arrays_of(self.env.reset(ask)["observation"])

    def step(self, actions: np.ndarray) -> TensorDictBase:
        """Step all worlds with actions [N, nu]."""
        action = torch.as_tensor(actions, dtype=torch.float32, device=self.env.device)
        return self.env.step(TensorDict({"action": action}, self.env.batch_size))["next"]

    def infos(self, step: TensorDictBase) -> Arrays:
        """Costs (float64) and `goal_met` of a step, [N] each."""
        costs = {key: step[key].squeeze(-1).double().cpu().numpy() for key in self.env.cost_keys}
        return costs | {"goal_met": step["goal_met"].squeeze(-1).cpu().numpy()}

    def positions(self) -> dict[str, Any]:
        """Where everything is now, by kind [N, K, 3] (m), under `positions`; or nothing."""
        if not self._with_positions:
            return {}
        return {"positions": arrays_of(self.env.get_positions())}

    def show(self) -> None:
        """Bring the viewer, if there is to be one, up to date, no faster than real time."""
        if not self._is_shown:
            return
        left = self._shown_at + self.seconds_per_step - time.monotonic()
        time.sleep(max(0.0, left))
        self.env.show()
        self._shown_at = time.monotonic()
