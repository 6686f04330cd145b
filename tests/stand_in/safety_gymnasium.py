"""Stands in for the package: environments whose step returns six values.

What is imitated is its release 1.0 on Gymnasium 0.28: `make`, the limit of time, kinds of costs and
their sum in `info`.
"""

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec


class Ice(gymnasium.Env):
    """A point slides; right of 0 a step costs 1, and speed costs itself; far out it ends."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-2.0, 4.0, (1,), np.float64)

    def __init__(self, border=2.0, render_mode=None):
        self.border, self.render_mode = border, render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed = self.np_random.uniform(-1, 1), 0.0
        return np.array([self.place, self.speed]), {}

    def step(self, action):
        assert -2 - 1e-6 <= action[0] <= 4 + 1e-6, action
        self.speed = float(action[0])
        self.place += 0.3 * self.speed
        kinds = {"cost_right": float(self.place > 0), "cost_fast": abs(self.speed)}
        cost = sum(kinds.values())
        info = {**kinds, "cost_sum": cost, "goal_met": False}
        seen = np.array([self.place, self.speed])
        return seen, self.speed, cost, abs(self.place) > self.border, False, info

    def render(self):
        picture = np.zeros((20, 60, 3), dtype=np.uint8)
        picture[:, int(np.clip(30 + 9 * self.place, 0, 59))] = 255
        return picture


class Limited(gymnasium.Wrapper):
    """The package's own limit of time, for six values."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.steps = steps

    @property
    def spec(self):
        return EnvSpec("SafetyStandIn-v0", max_episode_steps=self.steps)

    def reset(self, **kwargs):
        self.taken = 0
        return self.env.reset(**kwargs)

    def step(self, action):
        *values, _, info = self.env.step(action)
        self.taken += 1
        return (*values, self.taken >= self.steps, info)


def make(id, max_episode_steps=None, **kwargs):
    assert id == "SafetyIce1-v0", f"Environment {id} is not registered in safety-gymnasium."
    return Limited(Ice(**kwargs), max_episode_steps or 12)
