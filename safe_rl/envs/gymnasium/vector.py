"""A batch of worlds in Gymnasium's vector interface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from safe_rl.envs.gymnasium.worlds import (
    RENDER_MODES,
    Observation,
    Seeds,
    SpecWithLength,
    Worlds,
    arrays_of,
    configure,
    take,
)
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.display import Camera
from safe_rl.envs.safety_gym.env import SafetyGymEnv


class SafetyGymnasiumVectorEnv(SpecWithLength, VectorEnv[Any, np.ndarray, np.ndarray]):
    """A batch of worlds in Gymnasium's vector interface, stepped together on a thread pool.

    Row k of a seed has the same episodes whatever `num_envs` is; row 0 has those of
    `SafetyGymnasiumEnv` with that seed.

    Args:
        num_envs: number of worlds, N.
        name: of the environment; None for the defaults of every configuration key.
        config: keys to change, or a whole `SafetyGymConfig`.
        autoreset_mode: when an ended episode is followed by a new one: with the next step, within
            the same step (what ended is then in `infos["final_obs"]` and `infos["final_info"]`), or
            by `reset(options={"reset_mask": mask})`.
        render_mode: "rgb_array" for frames, "human" for a viewer of row 0, None for neither.
        camera: of the frames, as `SafetyGymEnv.render` takes it.
        width: of a frame [pixels].
        height: of a frame [pixels].
        num_threads: threads that step the physics; 0 for one per core.
        sleep: as `SafetyGymEnv` takes it.
        positions: put `infos["positions"]` into all infos: float64 [N, K, 3] by kind (m), as
            `SafetyGymEnv.get_positions` has them.
        max_episode_steps: takes the place of `num_steps`; `gymnasium.make_vec` passes it on.

    Raises:
        ConfigError: for a configuration that cannot be used.
        OpenGLError: for the mode "human" where there is no screen.

    Examples:
        >>> import gymnasium
        >>> envs = gymnasium.make_vec("Safexp-PointGoal1-v0", num_envs=3)
        >>> _, _ = envs.reset(seed=0)
        >>> _, _, _, _, infos = envs.step(envs.action_space.sample())
        >>> infos["cost"].shape
        (3,)
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": 50,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        name: str | None = None,
        config: Mapping[str, Any] | SafetyGymConfig | None = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        camera: Camera = "fixedfar",
        width: int = 480,
        height: int = 360,
        num_threads: int = 0,
        sleep: bool = True,
        positions: bool = False,
        max_episode_steps: int | None = None,
    ) -> None:
        config = configure(name, config)
        if max_episode_steps is not None:
            config = config.replace(num_steps=max_episode_steps)
        self._worlds = Worlds(config, num_envs, num_threads, sleep, render_mode, positions)
        self._num_steps = self.safety_gym.max_episode_steps
        self._view: dict[str, Any] = {"camera": camera, "width": width, "height": height}
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = self._worlds.metadata() | {"autoreset_mode": self.autoreset_mode}
        self.single_observation_space = self._worlds.observation_space
        self.single_action_space = self._worlds.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended = np.zeros(num_envs, dtype=bool)

    @property
    def safety_gym(self) -> SafetyGymEnv:
        """The batched environment inside."""
        return self._worlds.env

    def reset(
        self, *, seed: Seeds = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start new episodes.

        Args:
            seed: determines the episodes of all worlds; or one for every world [N], which then has
                those of `SafetyGymnasiumEnv` with that seed, and None goes on as it was seeded.
            options: `reset_mask`, bool [N], restricts the reset to some worlds.

        Raises:
            ValueError: for a mask of another shape or type, or a seed for a part of the worlds,
                or seeds of another number.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            self._check_mask(mask, seed)
        self._worlds.seed(seed, self.np_random)
        observation = self._worlds.reset(mask)
        self._ended = self._ended & ~mask if mask is not None else np.zeros_like(self._ended)
        self._worlds.show()
        new = np.ones(self.num_envs, dtype=bool) if mask is None else mask
        return observation, with_masks(self._worlds.positions(), new)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action [N, nu] in every world, see `autoreset_mode` for those that ended."""
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise RuntimeError(
                f"Worlds {np.flatnonzero(self._ended).tolist()} have ended: call "
                "reset(options={'reset_mask': terminations | truncations}) before the next step."
            )
        step = self._worlds.step(actions)
        observation, infos = arrays_of(step["observation"]), self._worlds.infos(step)
        reward = step["reward"].squeeze(-1).double().numpy()
        terminated = step["terminated"].squeeze(-1).numpy()
        truncated = step["truncated"].squeeze(-1).numpy()
        begins = self._begins(terminated | truncated)
        reported = with_masks(infos, ~begins)
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            reported |= final_infos(observation, infos | self._worlds.positions(), begins)
        else:
            # The step of a world that had already ended counts for nothing.
            reward, terminated, truncated = (
                np.where(begins, np.zeros_like(values), values)
                for values in (reward, terminated, truncated)
            )
            self._ended = terminated | truncated
        if begins.any():
            observation = choose(begins, self._worlds.reset(begins), observation)
        # Those of a world that begins are of its new episode.
        reported |= with_masks(self._worlds.positions(), np.ones_like(begins))
        self._worlds.show()
        return observation, reward, terminated, truncated, reported

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a frame of every world, uint8 [height, width, 3], in the mode "rgb_array"."""
        if self.render_mode == "rgb_array":
            return tuple(self.safety_gym.render(**self._view))
        self._worlds.show()
        return None

    def close_extras(self, **kwargs: Any) -> None:
        """Close the viewer and free what OpenGL holds."""
        self.safety_gym.close()

    def _begins(self, ends: np.ndarray) -> np.ndarray:
        """Worlds [N] that start an episode in this step, given those whose episode ends in it."""
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            return ends
        return self._ended.copy()

    def _check_mask(self, mask: np.ndarray, seed: Seeds) -> None:
        if getattr(mask, "shape", None) != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be a boolean array of shape ({self.num_envs},) with "
                f"at least one True, got {mask!r}."
            )
        if seed is not None:
            raise ValueError("A seed is for all worlds: give either a seed or a 'reset_mask'.")


def with_masks(infos: Mapping[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Add to every array [N, …] the mask `_<key>` of the worlds that it speaks of; 0 elsewhere."""
    masked = {
        key: with_masks(values, mask)
        if isinstance(values, dict)
        else _choose(mask, values, np.zeros_like(values))
        for key, values in infos.items()
    }
    return masked | {f"_{key}": mask.copy() for key in infos}


def final_infos(
    observation: Observation, infos: Mapping[str, Any], ends: np.ndarray
) -> dict[str, Any]:
    """Describe what ended, as Gymnasium does for episodes that are followed within the step."""
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


def choose(mask: np.ndarray, chosen: Observation, other: Observation) -> Observation:
    """Return the rows of `chosen` where the mask [N] says, of `other` elsewhere."""
    if isinstance(chosen, dict) and isinstance(other, dict):
        return {key: _choose(mask, chosen[key], other[key]) for key in other}
    return _choose(mask, chosen, other)


def _choose(mask: np.ndarray, chosen: Any, other: Any) -> np.ndarray:
    return np.where(mask.reshape(-1, *[1] * (other.ndim - 1)), chosen, other)
