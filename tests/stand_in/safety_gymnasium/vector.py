"""Batches as Gymnasium 0.28 had them, with a cost."""

import numpy as np
from gymnasium.vector.utils import batch_space

import safety_gymnasium


class SafetySyncVectorEnv:
    """Steps environments in line; one whose episode ends begins anew within the step."""

    def __init__(self, makers):
        self.envs = [make() for make in makers]
        self.num_envs = len(self.envs)
        self.single_observation_space = self.envs[0].observation_space
        self.single_action_space = self.envs[0].action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed=None, options=None):
        seeds = [None if seed is None else seed + i for i in range(self.num_envs)]
        seen = [env.reset(seed=s)[0] for env, s in zip(self.envs, seeds, strict=True)]
        return np.stack(seen), {}

    def step(self, actions):
        seen, numbers, infos = [], [], {}
        for row, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            observation, *values, info = env.step(action)
            if values[2] or values[3]:
                last = {"final_observation": observation, "final_info": info}
                observation, info = env.reset()
                info = {**info, **last}
            seen.append(observation)
            numbers.append(values)
            self._note(infos, info, row)
        rewards, costs, terminated, truncated = map(np.array, zip(*numbers, strict=True))
        return np.stack(seen), rewards, costs, terminated, truncated, infos

    def _note(self, infos, info, row):
        for key, value in info.items():
            kind = float if isinstance(value, float) else object
            array = infos.setdefault(key, np.zeros(self.num_envs, dtype=kind))
            array[row] = value
            infos.setdefault(f"_{key}", np.zeros(self.num_envs, dtype=bool))[row] = True

    def close(self):
        for env in self.envs:
            env.close()


def make(env_id, num_envs=1, asynchronous=True, **kwargs):
    return SafetySyncVectorEnv([lambda: safety_gymnasium.make(env_id, **kwargs)] * num_envs)
