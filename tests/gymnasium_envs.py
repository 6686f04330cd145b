"""A small environment that is registered with Gymnasium, as somebody else's would be."""

import gymnasium
import numpy as np


class Walk(gymnasium.Env):
    """A point on a line is to go right; going fast costs, and being far out ends the episode."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, border=3.0, nested=False, broken=False, render_mode=None):
        self.border, self.nested, self.broken = border, nested, broken
        self.render_mode = render_mode
        if nested:
            self.observation_space = gymnasium.spaces.Dict(
                place=gymnasium.spaces.Box(-np.inf, np.inf, (2,)),
                side=gymnasium.spaces.Discrete(2),
            )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed = self.np_random.uniform(-1, 1), 0.0
        return self._observe(), {}

    def step(self, action):
        if self.broken:
            raise ArithmeticError("the line is broken")
        self.speed = float(action[0])
        self.place += 0.3 * self.speed
        info = {"fast": float(abs(self.speed) > 1), "far": abs(self.place)}
        return self._observe(), self.speed, abs(self.place) > self.border, False, info

    def render(self):
        if self.render_mode is None:
            return None
        picture = np.zeros((20, 60, 3), dtype=np.uint8)
        picture[:, int(np.clip(30 + 9 * self.place, 0, 59))] = 255
        return picture

    def _observe(self):
        place = np.array([self.place, self.speed])
        return {"place": place, "side": int(self.place > 0)} if self.nested else place


gymnasium.register("Walk-v0", entry_point=f"{__name__}:Walk", max_episode_steps=25)
