"""Small environments of Gymnasium, as somebody else's would be; some are registered."""

import gymnasium
import numpy as np


class Walk(gymnasium.Env):
    """A point on a line is to go right; going fast costs, and being far out ends the episode."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, border=3.0, nested=False, render_mode=None):
        self.border, self.nested = border, nested
        self.render_mode = render_mode
        if nested:
            self.observation_space = gymnasium.spaces.Dict(
                place=gymnasium.spaces.Box(-np.inf, np.inf, (2,)), side=gymnasium.spaces.Discrete(2)
            )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed = self.np_random.uniform(-1, 1), 0.0
        return self._observe(), {}

    def step(self, action):
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


class Boxes(gymnasium.Env):
    """Two choices at once; each has its own reward and cost, and one of them counts from 1."""

    action_space = gymnasium.spaces.MultiDiscrete([3, 2], start=[0, 1])
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        first, second = action
        info = {"cost": [0.0, 0.2, 1.0][first] + [0.0, 0.5][second - 1]}
        return np.ones(1, np.float32), float(first + second - 1), False, False, info


class Recall(gymnasium.Env):
    """Shows a side once, at the beginning; every step that takes the side earns 1.

    Without a memory half of the later steps do, which makes 4.5 of 8.
    """

    action_space = gymnasium.spaces.Discrete(2)
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.side = int(self.np_random.integers(2))
        return np.array([2.0 * self.side - 1], np.float32), {}

    def step(self, action):
        earned = float(action == self.side)
        return np.zeros(1, np.float32), earned, False, False, {"cost": 1 - earned}


class Tank(gymnasium.Env):
    """A tank that is filled by 0 to 2 litres a step: the amount is the reward, above 1 it costs."""

    action_space = gymnasium.spaces.Box(0.0, 2.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.level = np.zeros(1, np.float32)
        return self.level, {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.level = self.level + action / 40
        cost = np.float32(max(0.0, action[0] - 1))
        return self.level, float(action[0]), False, False, {"cost": cost}


class Costly(gymnasium.Wrapper):
    """The pendulum with costs for being fast and for being upright."""

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        info["cost_speed"] = float(abs(observation[2]) > 1.0)
        info["cost_upright"] = max(0.0, float(observation[0]))
        info["torque"] = float(action[0])
        return observation, reward, terminated, truncated, info


def make_pendulum(**kwargs):
    return Costly(gymnasium.make("Pendulum-v1", **kwargs))


gymnasium.register("Recall-v0", entry_point=f"{__name__}:Recall", max_episode_steps=8)
gymnasium.register("Boxes-v0", entry_point=f"{__name__}:Boxes", max_episode_steps=10)
gymnasium.register("Tank-v0", entry_point=f"{__name__}:Tank", max_episode_steps=20)
