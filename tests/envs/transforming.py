"""Environments and transforms that the tests of transforms share."""

import gymnasium_envs  # noqa: F401, registers Walk-v0
import torch
from point_mass import PointMass
from torchrl.envs.transforms import VecNormV2

from safe_rl.envs import SafetyGymEnv, from_gymnasium
from safe_rl.envs.transforms import (
    ActionDelay,
    ActionFilter,
    ActionRepeat,
    EarlyTermination,
    Saute,
    SensorNoise,
    Simmer,
    transform_env,
)

SAUTE = {"discount": 0.9, "unsafe_reward": -1.0, "rescale_budgets": False}
SHORT = {"robot_base": "point", "num_steps": 8}


class Priced(PointMass):
    """The point mass at costs [N, T] of our choice; `cost_north` is twice `cost`."""

    def __init__(self, costs):
        self.costs = torch.tensor(costs)
        super().__init__(*self.costs.shape)

    def _step(self, tensordict):
        step = super()._step(tensordict)
        step["cost"] = self.costs.gather(1, self._step_count - 1)
        step["cost_north"] = 2 * step["cost"]
        return step


def half_speed(step, speed=0.5):
    return step["action"].clamp(-speed, speed)


TRANSFORMS = {
    "saute": lambda: Saute({"cost": 2.0}, **SAUTE),
    "noise": lambda: SensorNoise(0.5),
    "delay": lambda: ActionDelay(2),
    "simmer": lambda: Simmer({"cost": 2.0}, first=0.25, steps=16, **SAUTE),
    "early_termination": lambda: EarlyTermination({"cost": 2.0}),
    "action_filter": lambda: ActionFilter(half_speed),
    "action_repeat": lambda: ActionRepeat(3),  # the last one
}
ENVIRONMENTS = {
    "point_mass": lambda: PointMass(3),
    "safety_gym": lambda: SafetyGymEnv(SHORT, 3, seed=0),
    "dictionary": lambda: SafetyGymEnv(SHORT | {"observation_flatten": False}, 3, seed=0),
    "gymnasium": lambda: from_gymnasium("Walk-v0", num_envs=3, cost_keys=["fast"], seed=0),
    "choices": lambda: from_gymnasium("CartPole-v1", num_envs=3, cost_keys=["cost"], seed=0),
}


def transformed(env, *names, evaluating=False, seed=None, **others):
    """An environment, or that of a name, with the transforms of some names and the others."""
    env = ENVIRONMENTS[env]() if isinstance(env, str) else env
    made = {name: TRANSFORMS[name]() for name in names} | others
    return transform_env(env, made, evaluating=evaluating, seed=seed)


def still(env, steps, action=0.0):
    """Rollout with one and the same action, over the ends of episodes."""
    chosen = torch.full(env.action_spec.shape, action)
    return env.rollout(steps, lambda td: td.set("action", chosen), break_when_any_done=False)


def normed():
    """Observations by the statistics of this environment's own steps."""
    return VecNormV2(in_keys=["observation"])
