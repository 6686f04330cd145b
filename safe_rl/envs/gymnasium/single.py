"""One world in Gymnasium's interface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from safe_rl.envs.gymnasium.worlds import (
    RENDER_MODES,
    Observation,
    SpecWithLength,
    Worlds,
    arrays_of,
    configure,
    take,
)
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.display import Camera
from safe_rl.envs.safety_gym.env import SafetyGymEnv


class SafetyGymnasiumEnv(SpecWithLength, gymnasium.Env[Any, np.ndarray]):
    """One world in Gymnasium's interface.

    Args:
        name: of the environment; None for the defaults of every configuration key.
        config: keys to change, or a whole `SafetyGymConfig`.
        render_mode: "rgb_array" for frames, "human" for MuJoCo's viewer, None for neither.
        camera: of the frames, as `SafetyGymEnv.render` takes it.
        width: of a frame [pixels].
        height: of a frame [pixels].
        sleep: as `SafetyGymEnv` takes it.
        positions: put `info["positions"]` into every info: float64 [K, 3] by kind (m), as
            `SafetyGymEnv.get_positions` has them.

    Raises:
        ConfigError: for a configuration that cannot be used.
        OpenGLError: for the mode "human" where there is no screen.

    Examples:
        >>> import gymnasium
        >>> env = gymnasium.make("Safexp-PointGoal1-v0", config={"hazards_num": 3})
        >>> _, _ = env.reset(seed=0)
        >>> _, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> sorted(info)
        ['cost', 'cost_exception', 'cost_hazards', 'goal_met']
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        name: str | None = None,
        config: Mapping[str, Any] | SafetyGymConfig | None = None,
        *,
        render_mode: str | None = None,
        camera: Camera = "fixedfar",
        width: int = 480,
        height: int = 360,
        sleep: bool = True,
        positions: bool = False,
    ) -> None:
        self._worlds = Worlds(configure(name, config), 1, 1, sleep, render_mode, positions)
        self._num_steps = self.safety_gym.max_episode_steps
        self._view: dict[str, Any] = {"camera": camera, "width": width, "height": height}
        self.render_mode = render_mode
        self.metadata = self._worlds.metadata()
        self.observation_space = self._worlds.observation_space
        self.action_space = self._worlds.action_space

    @property
    def safety_gym(self) -> SafetyGymEnv:
        """The environment inside, a batch of one."""
        return self._worlds.env

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; a seed determines it and all that follow."""
        super().reset(seed=seed)
        self._worlds.seed(seed, self.np_random)
        observation = take(self._worlds.reset(), 0)
        self._worlds.show()
        return observation, self._positions()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Take one action [nu]."""
        step = self._worlds.step(np.asarray(action)[None])
        infos = {key: values[0].item() for key, values in self._worlds.infos(step).items()}
        self._worlds.show()
        return (
            take(arrays_of(step["observation"]), 0),
            step["reward"].item(),
            step["terminated"].item(),
            step["truncated"].item(),
            infos | self._positions(),
        )

    def render(self) -> np.ndarray | None:
        """Return a frame, uint8 [height, width, 3], in the mode "rgb_array"."""
        if self.render_mode == "rgb_array":
            return self.safety_gym.render(0, **self._view)
        self._worlds.show()
        return None

    def close(self) -> None:
        """Close the viewer and free what OpenGL holds."""
        self.safety_gym.close()

    def _positions(self) -> dict[str, Any]:
        return {key: take(values, 0) for key, values in self._worlds.positions().items()}
