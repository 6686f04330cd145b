"""One robot of the velocity family in Gymnasium's interface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict

from safe_rl.envs.gymnasium.worlds import SpecWithLength
from safe_rl.envs.velocity.env import VelocityEnv
from safe_rl.envs.velocity.suite import resolve_velocity

__all__ = ["VelocityGymnasiumEnv"]


class VelocityGymnasiumEnv(SpecWithLength, gymnasium.Env[np.ndarray, np.ndarray]):
    """One robot with a speed limit, under ids such as `SafeHopperVelocity-v0`.

    Args:
        name: of the environment.
        config: keys to change.
        render_mode: "rgb_array" for frames, or None.
        width: of a frame [pixels].
        height: of a frame [pixels].

    Raises:
        ConfigError: for a configuration that cannot be used.
        ValueError: for another render mode.

    Examples:
        >>> import gymnasium
        >>> env = gymnasium.make("SafeHopperVelocity-v0", config={"velocity_threshold": 0.5})
        >>> _, _ = env.reset(seed=0)
        >>> sorted(env.step(env.action_space.sample())[-1])
        ['cost', 'cost_velocity']
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        name: str,
        config: Mapping[str, Any] | None = None,
        *,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be rgb_array or None, got {render_mode!r}.")
        self.robot = VelocityEnv(resolve_velocity(name).replace(**(config or {})), 1, "cpu", 0, 1)
        self._num_steps = self.robot.max_episode_steps
        # in real time, as Gymnasium's
        rate = max(1, round(1 / self.robot.seconds_per_step))
        self.metadata = {**self.metadata, "render_fps": rate}
        self.render_mode, self._size = render_mode, {"width": width, "height": height}
        size = self.robot.observation_spec["observation"].shape[-1]
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        bounds = self.robot.action_spec.space
        self.action_space = gymnasium.spaces.Box(
            bounds.low[0].numpy(), bounds.high[0].numpy(), dtype=np.float32
        )
        self._is_seeded = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; a seed determines it and all that follow."""
        super().reset(seed=seed)
        if seed is not None or not self._is_seeded:
            drawn = int(self.np_random.integers(2**62)) if seed is None else seed
            self.robot.set_seed(drawn)
        self._is_seeded = True
        return self.robot.reset()["observation"][0].numpy().copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one action [nu]."""
        given = torch.as_tensor(action, dtype=torch.float32)[None]
        step = self.robot.step(TensorDict({"action": given}, [1]))["next"]
        return (
            step["observation"][0].numpy().copy(),
            step["reward"].item(),
            step["terminated"].item(),
            step["truncated"].item(),
            {key: step[key].item() for key in self.robot.cost_keys},
        )

    def render(self) -> np.ndarray | None:
        """Return a frame, uint8 [height, width, 3], in the mode "rgb_array"."""
        return None if self.render_mode is None else self.robot.render(0, **self._size)

    def close(self) -> None:
        """Free what OpenGL holds."""
        self.robot.close()
