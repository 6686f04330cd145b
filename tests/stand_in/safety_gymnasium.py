"""Stands in for the package: environments whose step returns six values.

What is imitated is its release 1.0 on Gymnasium 0.28: `make`, the limit of time, kinds of costs and
their sum in `info`; and its `Builder`, whose task ends episodes itself after `num_steps` steps.
"""

from types import SimpleNamespace

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


class Builder(Ice):
    """Never far out; its exceptions cost 1 and have no other kind in `info`."""

    def __init__(self, **kwargs):
        super().__init__(border=np.inf, **kwargs)
        self.task = SimpleNamespace(num_steps=12)

    def reset(self, **kwargs):
        self.steps = 0
        return super().reset(**kwargs)

    def step(self, action):
        seen, reward, cost, terminated, _, info = super().step(action)
        self.steps += 1
        if self.steps == 3:
            cost, info = 1.0, {"cost_exception": 1.0}
        return seen, reward, cost, terminated, self.steps >= self.task.num_steps, info


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
        *values, truncated, info = self.env.step(action)
        self.taken += 1
        return (*values, truncated or self.taken >= self.steps, info)


def make(id, max_episode_steps=None, **kwargs):
    worlds = {"SafetyIce1-v0": (Ice, 12), "SafetyBuilt-v0": (Builder, 10**9)}
    assert id in worlds, f"Environment {id} is not registered in safety-gymnasium."
    world, steps = worlds[id]
    return Limited(world(**kwargs), max_episode_steps or steps)
