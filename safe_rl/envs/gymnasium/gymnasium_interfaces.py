"""The simulated environments in Gymnasium's two interfaces: one environment, and a batch."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from safe_rl.envs.gymnasium.world_arrays import (
    RENDER_MODES,
    Config,
    Observation,
    Worlds,
    choose,
    final_infos,
    take,
    with_masks,
)


class WorldEnv(Worlds, gymnasium.Env[Any, np.ndarray]):
    """One simulated environment in Gymnasium's interface.

    Args:
        name: Name of the environment; None uses Safety Gym with the default of every key.
        config: Keys to change, or a whole `SafetyGymConfig` or `VelocityConfig` of its family.
            `num_steps` is the length of episodes; `max_episode_steps` of `gymnasium.make` can only
            shorten them.
        render_mode: "rgb_array" for frames, or None; "human" is for `gymnasium.make`, whose wrapper
            shows the frames in a window.
        camera: Camera of the frames, as in the environment's `render`; None is its first.
        width: Width of a frame [pixels].
        height: Height of a frame [pixels].
        sleep: As in `SafetyGymEnv`.
        positions: Whether every info has `info["positions"]`: float64 [K, 3] by kind (m), as
            in `SafetyGymEnv.get_positions`.

    Raises:
        ConfigError: For a configuration that cannot be used.
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

    def __init__(self, name: str | None = None, config: Config = None, **settings: Any) -> None:
        self._open(name, config, 1, 1, None, **settings)
        self.observation_space, self.action_space = self.spaces()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; a seed determines this one and all later ones."""
        super().reset(seed=seed)
        self._seed(seed, self.np_random)
        observation = take(self._reset(), 0)
        return observation, self._position()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one action [nu]."""
        observation, values, infos = self._step(np.asarray(action)[None])
        reward, terminated, truncated = (value[0].item() for value in values)
        # TorchRL reads only what has a dtype from an info, and Gymnasium batches only numbers and
        # arrays of NumPy; its booleans are not among these, so an event is an array without axes.
        info = {
            key: value[0] if value.dtype != bool else value[0, ...] for key, value in infos.items()
        } | self._position()
        return take(observation, 0), reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Return a frame, uint8 [height, width, 3], in the mode "rgb_array"."""
        return self.batch.render(0, **self._view) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the memory of OpenGL."""
        self.batch.close()

    def _position(self) -> dict[str, Any]:
        return {key: take(values, 0) for key, values in self._positions().items()}


class WorldVectorEnv(Worlds, VectorEnv[Any, np.ndarray, np.ndarray]):
    """A batch of environments in Gymnasium's vector interface, stepped together on a thread pool.

    With a given seed, the episodes of row k do not depend on `num_envs`. Row 0 has the episodes of
    `WorldEnv` with that seed.

    Args:
        num_envs: Number of environments, N.
        name: As in `WorldEnv`.
        config: As in `WorldEnv`.
        autoreset_mode: When a new episode follows one that ended: with the next step, within the
            same step (`infos["final_obs"]` and `infos["final_info"]` then describe the end), or by
            `reset(options={"reset_mask": mask})`.
        num_threads: Threads that step the physics; 0 for one per core.
        max_episode_steps: Replaces `num_steps`; `gymnasium.make_vec` passes it on.
        settings: Other arguments of `WorldEnv`; positions are [N, K, 3].

    Raises:
        ConfigError: For a configuration that cannot be used.

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
        config: Config = None,
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        num_threads: int = 0,
        max_episode_steps: int | None = None,
        **settings: Any,
    ) -> None:
        self._open(name, config, num_envs, num_threads, max_episode_steps, **settings)
        self.num_envs, self.autoreset_mode = num_envs, AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = self.spaces()
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
            options: `reset_mask`, bool [N], restricts the reset to some environments.

        Raises:
            ValueError: For a mask of another shape or type, for a mask together with a seed, or
                if the number of seeds is not N.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            self._check_mask(mask, seed)
        self._seed(seed, self.np_random)
        observation = self._reset(mask)
        new = np.ones(self.num_envs, dtype=bool) if mask is None else mask
        self._ended = self._ended & ~new
        return observation, with_masks(self._positions(), new)

    def step(
        self, actions: np.ndarray
    ) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action [N, nu] in all environments; `autoreset_mode` says what follows an end."""
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise RuntimeError(
                f"Environments {np.flatnonzero(self._ended).tolist()} have ended: call "
                "reset(options={'reset_mask': terminations | truncations}) before the next step."
            )
        observation, (reward, terminated, truncated), infos = self._step(actions)
        within = self.autoreset_mode is AutoresetMode.SAME_STEP
        # Environments that start an episode in this step.
        begins = terminated | truncated if within else self._ended
        reported = with_masks(infos, ~begins)
        if within:
            reported |= final_infos(observation, infos | self._positions(), begins)
        else:
            # the step of an environment that had already ended does not count
            reward = np.where(begins, 0.0, reward)
            terminated, truncated = terminated & ~begins, truncated & ~begins
            self._ended = terminated | truncated
        if begins.any():
            observation = choose(begins, self._reset(begins), observation)
        # Where an episode begins, the positions are those of the new episode.
        reported |= with_masks(self._positions(), np.ones_like(begins))
        return observation, reward, terminated, truncated, reported

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return one frame per row, uint8 [height, width, 3], in the mode "rgb_array"."""
        return tuple(self.batch.render(**self._view)) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """Free the memory of OpenGL."""
        self.batch.close()

    def _check_mask(self, mask: np.ndarray, seed: Any) -> None:
        if getattr(mask, "shape", None) != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise ValueError(
                f"options['reset_mask'] must be a boolean array of shape ({self.num_envs},) with "
                f"at least one True, got {mask!r}."
            )
        if seed is not None:
            raise ValueError("A seed is for all environments: give a seed or a 'reset_mask'.")
