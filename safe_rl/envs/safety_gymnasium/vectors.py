"""Batches of environments with six values, as batches of Gymnasium that nobody resets unasked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from safe_rl.envs.costs import COST

__all__ = ["DeferredResets", "PlainVectorEnv"]


class DeferredResets(VectorEnv):
    """A batch that starts a new episode within the step that ends one, as if it waited.

    The observation of that step is the one that `info["final_observation"]` holds; the new one is
    what the reset that is asked for afterwards returns.

    Args:
        env: its step returns six arrays.
        kinds: names in `info` of kinds of costs; 0 where it reports none.

    Attributes:
        env: the batch.
    """

    def __init__(self, env: Any, kinds: Sequence[str]) -> None:
        self.env, self._kinds = env, list(kinds)
        self.num_envs = int(env.num_envs)
        self.single_observation_space = env.single_observation_space
        self.single_action_space = env.single_action_space
        self.observation_space, self.action_space = env.observation_space, env.action_space
        self.render_mode = getattr(env, "render_mode", None)
        self.autoreset_mode = AutoresetMode.DISABLED
        given = getattr(env, "metadata", None) or {}
        self.metadata = {**given, "autoreset_mode": self.autoreset_mode}
        self._begun: np.ndarray | None = None

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes everywhere; or show those that have begun, by `reset_mask` [N]."""
        others = dict(options or {})
        mask = others.pop("reset_mask", None)
        if mask is None or self._begun is None:
            self._begun = np.array(self.env.reset(seed=seed, **_given(others))[0])
        return self._begun.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action [N, A] in every environment."""
        values: tuple[Any, ...] = self.env.step(actions)
        if len(values) != 6:
            raise ValueError(
                f"A step of {self.env} returned {len(values)} values instead of six (observations, "
                "rewards, costs, terminated, truncated, infos)."
            )
        begun, rewards, costs, terminated, truncated, infos = values
        self._begun = np.array(begun)
        ends = np.asarray(terminated) | np.asarray(truncated)
        seen, reported = self._begun.copy(), {COST: np.array(costs, np.float64)}
        reported |= {key: np.zeros(self.num_envs) for key in self._kinds}
        for key in self._kinds:
            reported[key] += np.asarray(infos.get(key, 0.0), np.float64) * ~ends
        for row in np.flatnonzero(ends):
            # of steps that end episodes, `info` is that of the reset
            seen[row] = infos["final_observation"][row]
            last = infos["final_info"][row]
            for key in self._kinds:
                reported[key][row] = last.get(key, 0.0)
        return seen, np.array(rewards), np.array(terminated), np.array(truncated), reported

    def render(self) -> tuple[Any, ...] | None:
        """Return a frame of every environment, where they draw."""
        frames = self.env.render()
        return None if frames is None else tuple(frames)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the batch."""
        self.env.close()


class PlainVectorEnv(VectorWrapper):
    """A batch as networks take it: one float32 vector is observed, actions are in [-1, 1].

    They are cut to that and stretched to the bounds; choices stay as they are.

    Args:
        env: observations are arrays; ended environments are reset by a mask, and only then.

    Raises:
        ValueError: for other observations, or actions that are neither bounded nor choices.
    """

    def __init__(self, env: VectorEnv) -> None:
        seen, actions = env.single_observation_space, env.single_action_space
        if not isinstance(seen, Box):
            raise ValueError(f"A batch has to observe arrays (a Box), not {seen}.")
        self._bounds: tuple[np.ndarray, np.ndarray] | None = None
        if isinstance(actions, Box) and actions.is_bounded():
            self._bounds = np.float32(actions.low), np.float32(actions.high)  # type: ignore[assignment]
            actions = Box(-1.0, 1.0, actions.shape, np.float32)
        elif not isinstance(actions, Discrete | MultiDiscrete):
            raise ValueError(f"Actions must be continuous and bounded, or choices, got {actions}.")
        super().__init__(env)
        self.single_observation_space = Box(-np.inf, np.inf, (int(np.prod(seen.shape)),))
        self.single_action_space = actions
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self.action_space = batch_space(actions, env.num_envs)
        self.autoreset_mode = AutoresetMode.DISABLED

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes, everywhere or where `options["reset_mask"]` [N] says."""
        observation, infos = self.env.reset(**kwargs)
        return self._vector(observation), infos

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action [N, A] in every environment."""
        if self._bounds is not None:
            low, high = self._bounds
            actions = low + (np.clip(actions, -1, 1) + 1) / 2 * (high - low)
        observation, *others = self.env.step(actions)
        return self._vector(observation), *others

    def _vector(self, observation: np.ndarray) -> np.ndarray:
        return np.asarray(observation, np.float32).reshape(self.num_envs, -1)


def _given(options: dict[str, Any]) -> dict[str, Any]:
    return {"options": options} if options else {}
