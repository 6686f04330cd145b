"""The simulated environments in Gymnasium's two interfaces: one environment, and a batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Composite, TensorSpec

from safe_rl.envs.families import env_node, make_env
from safe_rl.envs.keys import COST, ConfigError
from safe_rl.envs.simulated import SimulatedEnv

EPISODE_COST = "episode_cost"  # sum over the steps of the episode so far
NUM_SEEDS = 2**62
RENDER_MODES = ["rgb_array"]

Observation = np.ndarray | dict[str, np.ndarray]
Keys = Mapping[str, Any] | None


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
        config: Keys,
        *,
        num_envs: int,
        num_threads: int,
        render_mode: str | None = None,
        camera: Any = None,
        width: int = 480,
        height: int = 360,
        **unknown: Any,
    ) -> None:
        if "frameskip" in unknown:  # TorchRL tries it, and goes on without it for these words
            raise TypeError(f"{type(self).__name__} got an unexpected keyword argument 'frameskip'")
        for key in unknown:
            raise ConfigError(f"Unknown argument '{key}': keys are given as config={{'{key}': …}}.")
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(f"render_mode must be one of {RENDER_MODES}, got {render_mode!r}.")
        node = {**({} if name is None else env_node(name)), **(config or {})}
        batch = make_env(node, num_envs=num_envs, seed=0, num_threads=num_threads)
        self.batch = cast(SimulatedEnv, batch)
        self.render_mode = render_mode
        self._view: dict[str, Any] = {"camera": camera, "width": width, "height": height}
        self._episode_cost = np.zeros(num_envs)  # since the last reset
        rate = max(1, round(1 / self.batch.seconds_per_step))  # of real time
        self.metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": rate}

    @property
    def spec(self) -> EnvSpec | None:
        """The registered spec, with the configuration's `num_steps` as `max_episode_steps`."""
        return self._spec and replace(self._spec, max_episode_steps=self.batch.max_episode_steps)

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = spec

    def _spaces(self) -> tuple[gymnasium.Space, Box]:
        """Spaces of one environment's observation (by name if it is nested) and action."""
        seen = self.batch.observation_spec["observation"]
        ends = self.batch.action_spec.space
        actions = Box(ends.low[0].cpu().numpy(), ends.high[0].cpu().numpy(), dtype=np.float32)
        if isinstance(seen, Composite):
            return Dict({name: _box(part) for name, part in seen.items()}), actions
        return _box(seen), actions

    def _seed(self, seed: int | Sequence[int | None] | None, generator: Any) -> None:
        """Seed all later episodes; without a seed, the first call draws one."""
        if isinstance(seed, int):
            self.batch.set_seed(seed % NUM_SEEDS)
        elif not self._is_seeded:
            self.batch.set_seed(int(generator.integers(NUM_SEEDS)))
        if isinstance(seed, Sequence):
            self.batch.set_row_seeds([None if s is None else int(s) % NUM_SEEDS for s in seed])
        self._is_seeded = True

    def _reset(self, mask: np.ndarray) -> Observation:
        """Start episodes in the rows of a mask [N]; return the observation of all rows."""
        self._episode_cost[mask] = 0.0
        begins = TensorDict({"_reset": torch.from_numpy(mask).unsqueeze(-1)}, len(mask))
        # TorchRL's `reset` would return zeros for the other rows
        return _arrays(self.batch._reset(begins)["observation"])

    def _step(
        self, actions: np.ndarray
    ) -> tuple[Observation, tuple[Any, Any, Any], dict[str, Any]]:
        """Take a step; return observation, (reward, terminated, truncated) [N] each, and infos."""
        action = torch.as_tensor(actions, dtype=torch.float32, device=self.batch.device)
        if action.shape[:1] != self.batch.batch_size:
            raise ValueError(
                f"There are {self.batch.batch_size[0]} environments, and actions of the shape "
                f"{tuple(action.shape)}: give one row for each."
            )
        step = self.batch.step(TensorDict({"action": action}, self.batch.batch_size))["next"]
        names = ("reward", "terminated", "truncated", *self.batch.cost_keys, *self.batch.events)
        column = {name: step[name].squeeze(-1).cpu().numpy() for name in names}
        infos = {key: column[key].astype(np.float64) for key in self.batch.cost_keys}
        infos |= {key: column[key] for key in self.batch.events}
        self._episode_cost += infos[COST]
        # at every step, because wrappers such as `TimeLimit` may end the episode after any of them
        infos[EPISODE_COST] = self._episode_cost.copy()
        values = (column["reward"].astype(np.float64), column["terminated"], column["truncated"])
        return _arrays(step["observation"]), values, infos

    def _first_infos(self) -> dict[str, np.ndarray]:
        """Infos before the first step, with the keys of those of steps: costs of 0, no events."""
        costs = dict.fromkeys((*self.batch.cost_keys, EPISODE_COST), np.float64)
        kinds = costs | dict.fromkeys(self.batch.events, np.bool_)
        return {key: np.zeros(self.batch.batch_size, kind) for key, kind in kinds.items()}


class WorldEnv(Worlds, gymnasium.Env[Any, np.ndarray]):
    """One simulated environment in Gymnasium's interface.

    Args:
        name: Name of the environment; None uses Safety Gym with the default of every key.
        config: Keys to change. `num_steps` is the length of episodes; `max_episode_steps` of
            `gymnasium.make` can only shorten them.
        settings: `render_mode`, "rgb_array" for frames, or None ("human" is for `gymnasium.make`,
            whose wrapper shows the frames in a window); `camera` of the frames, as in the
            environment's `render`; their `width` and `height` [pixels].

    Raises:
        ConfigError: For a configuration that cannot be used, or another argument.
        ValueError: For another render mode.

    Examples:
        >>> import gymnasium
        >>> env = gymnasium.make("Safexp-PointGoal1-v0", config={"hazards_num": 3})
        >>> _, _ = env.reset(seed=0)
        >>> _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> sorted(info)
        ['cost', 'cost_exception', 'cost_hazards', 'episode_cost', 'goal_met']
    """

    metadata: dict[str, Any] = {"render_modes": RENDER_MODES}  # noqa: RUF012

    def __init__(self, name: str | None = None, config: Keys = None, **settings: Any) -> None:
        self._open(name, config, num_envs=1, num_threads=1, **settings)
        self.observation_space, self.action_space = self._spaces()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; a seed determines this one and all later ones."""
        super().reset(seed=seed)
        self._seed(seed, self.np_random)
        return _take(self._reset(np.ones(1, dtype=bool)), 0), _info(self._first_infos())

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one action [nu]."""
        observation, values, infos = self._step(np.asarray(action)[None])
        reward, terminated, truncated = (value[0].item() for value in values)
        return _take(observation, 0), reward, terminated, truncated, _info(infos)

    def render(self) -> np.ndarray | None:
        """Return a frame, uint8 [height, width, 3], in the mode "rgb_array"."""
        return self.batch.render(0, **self._view) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the memory of OpenGL."""
        self.batch.close()


class WorldVectorEnv(Worlds, VectorEnv[Any, np.ndarray, np.ndarray]):
    """A batch of environments in Gymnasium's vector interface, stepped together on a thread pool.

    With a given seed, the episodes of row k do not depend on `num_envs`. Row 0 has the episodes of
    `WorldEnv` with that seed.

    Args:
        num_envs: Number of environments, N.
        name: As in `WorldEnv`.
        config: As in `WorldEnv`.
        autoreset_mode: When a new episode follows one that ended: with the next step, or within the
            same step (`infos["final_obs"]` and `infos["final_info"]` then describe the end).
        num_threads: Threads that step the physics; 0 for one per core.
        max_episode_steps: Replaces `num_steps`; `gymnasium.make_vec` passes it on.
        settings: As in `WorldEnv`.

    Raises:
        ConfigError: For a configuration that cannot be used.
        ValueError: For another mode of autoreset.

    Examples:
        >>> import gymnasium
        >>> envs = gymnasium.make_vec("Safexp-PointGoal1-v0", num_envs=3)
        >>> _, _ = envs.reset(seed=0)
        >>> _, _, _, _, infos = envs.step(envs.action_space.sample())
        >>> infos["cost"].shape
        (3,)
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": RENDER_MODES,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        name: str | None = None,
        config: Keys = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        num_threads: int = 0,
        max_episode_steps: int | None = None,
        **settings: Any,
    ) -> None:
        length = {} if max_episode_steps is None else {"num_steps": max_episode_steps}
        keys = {**(config or {}), **length}
        self._open(name, keys, num_envs=num_envs, num_threads=num_threads, **settings)
        self.num_envs, self.autoreset_mode = num_envs, AutoresetMode(autoreset_mode)
        if self.autoreset_mode is AutoresetMode.DISABLED:
            raise ValueError("Episodes follow each other: autoreset_mode is NextStep or SameStep.")
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = self._spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: An integer that determines the episodes of all environments; or N of them, one per
                environment, which then has the episodes of `WorldEnv` with that seed. None keeps
                the present seeds.
            options: Not used.

        Raises:
            ValueError: If the number of seeds is not N, or for a `reset_mask`.
        """
        if (options or {}).get("reset_mask") is not None:
            raise ValueError("All environments are reset: there is no 'reset_mask'.")
        seed = seed.tolist() if isinstance(seed, np.ndarray | np.integer) else seed
        super().reset(seed=None if isinstance(seed, Sequence) else seed)
        self._seed(seed, self.np_random)
        self._ended[:] = False
        return self._reset(~self._ended), _with_masks(self._first_infos(), ~self._ended)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action [N, nu] in all environments; `autoreset_mode` says what follows an end."""
        observation, (reward, terminated, truncated), infos = self._step(actions)
        within = self.autoreset_mode is AutoresetMode.SAME_STEP
        # Environments that start an episode in this step.
        begins = terminated | truncated if within else self._ended
        # all rows report: those that begin have the zeros of a reset
        reported = _with_masks(infos, ~begins)
        reported |= {f"_{key}": np.ones_like(begins) for key in infos}
        if within:
            reported |= _final_infos(observation, infos, begins)
        else:
            # the step of an environment that had already ended does not count
            reward = np.where(begins, 0.0, reward)
            terminated, truncated = terminated & ~begins, truncated & ~begins
            self._ended = terminated | truncated
        if begins.any():
            observation = _choose(begins, self._reset(begins), observation)
        return observation, reward, terminated, truncated, reported

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return one frame per row, uint8 [height, width, 3], in the mode "rgb_array"."""
        return tuple(self.batch.render(**self._view)) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """Free the memory of OpenGL."""
        self.batch.close()


def _box(spec: TensorSpec) -> Box:
    """The space of one row of a spec."""
    ends = (spec.space.low[0].cpu().numpy(), spec.space.high[0].cpu().numpy())
    # a spec has half of the largest number in place of infinity, see `observation_spec`
    low, high = (np.where(abs(end) < 1e38, end, np.copysign(np.inf, end)) for end in ends)
    return Box(low, high, dtype=np.float32)


def _arrays(observation: torch.Tensor | TensorDictBase) -> Observation:
    """Observation of N environments as arrays, by name if it is nested."""
    if isinstance(observation, TensorDictBase):
        return {str(key): value.cpu().numpy() for key, value in observation.items()}
    return observation.cpu().numpy()


def _take(observation: Observation, row: int) -> Observation:
    if isinstance(observation, dict):
        return {key: value[row] for key, value in observation.items()}
    return observation[row]


def _info(infos: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The info of one environment, from arrays [1]."""
    # TorchRL reads only what has a dtype from an info, and Gymnasium batches only numbers and
    # arrays of NumPy; its booleans are not among these, so an event is an array without axes.
    return {key: value[0, ...] if value.dtype == bool else value[0] for key, value in infos.items()}


def _choose(mask: np.ndarray, chosen: Any, other: Any) -> Any:
    """Rows of `chosen` where the mask [N] is True, of `other` elsewhere."""
    if isinstance(other, dict):
        return {key: _choose(mask, chosen[key], other[key]) for key in other}
    return np.where(mask.reshape(-1, *[1] * (other.ndim - 1)), chosen, other)


def _with_masks(infos: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
    """Set every array [N] to 0 outside the mask [N], and add the mask as `_<key>`."""
    masked = {key: np.where(mask, values, np.zeros_like(values)) for key, values in infos.items()}
    return masked | {f"_{key}": mask.copy() for key in infos}


def _final_infos(
    observation: Observation, infos: Mapping[str, Any], ends: np.ndarray
) -> dict[str, Any]:
    """Describe the episodes that ended [N], as Gymnasium does in the mode that resets at once."""
    if not ends.any():
        return {}
    final: dict[str, Any] = {"final_obs": np.full(len(ends), None, dtype=object)}
    for row in np.flatnonzero(ends).tolist():
        final["final_obs"][row] = _take(observation, row)
    final["final_info"] = _with_masks(infos, ends)
    return final | {f"_{key}": ends.copy() for key in final}
