"""Letting resting objects sleep makes steps cheap; it must not change what is measured.

Contacts are chaotic, so two runs from one seed soon have nothing in common, and their means differ
by chance. Here worlds without sleep are set to the state of a run with sleep again and again. What
differs within such a window is caused by sleeping.
"""

import numpy as np
import pytest
import torch
from scipy import stats
from tensordict import TensorDict

from safe_rl.envs import SafetyGymEnv, resolve

MOST_CHAOTIC = 0.4  # share of worlds in which contacts differ
NUM_ENVS, NUM_WINDOWS, WINDOW = 100, 12, 25
TELLING, NEGLIGIBLE = 0.05, 0.005  # largest error and allowed bias, as shares of the measured value
SOLID = ("walls", "hazards", "vases", "pillars", "buttons", "gremlins")
SEEN_BY_RAYS = {
    **{"robot_base": "point", "task": "push", "lidar_type": "natural", "observe_sensors": False},
    **{f"{verb}_{kind}": True for verb in ("observe", "constrain") for kind in SOLID[1:]},
    **{f"{kind}_num": 2 for kind in SOLID},
    **{"walls_size": 0.2, "observe_box_lidar": True, "observe_walls": True},
}


def forward_driving() -> torch.Tensor:
    """Full speed ahead in random curves, which runs into things: actions [windows, T, N, 2]."""
    turn = 2 * torch.rand(NUM_WINDOWS, 1, NUM_ENVS) - 1
    actions = torch.stack([torch.ones_like(turn), turn], -1)
    return actions.expand(NUM_WINDOWS, WINDOW, NUM_ENVS, 2).clone()


def drive(env: SafetyGymEnv, tensordict: TensorDict, actions: torch.Tensor):
    """Take steps; returns where they end and the sums of reward and costs [N]."""
    keys, steps = ("reward", *env.cost_keys), []
    for action in actions:
        following = env.step(tensordict.set("action", action))
        steps.append(following["next"].select(*keys))
        tensordict = env.step_mdp(following)
    run = torch.stack(steps)
    return tensordict, {key: run[key].double().sum(0)[:, 0].numpy() for key in keys}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["PointGoal2", "PointPush2", "CarGoal2"])
def test_sleeping_biases_neither_returns_nor_costs(name):
    env = SafetyGymEnv(resolve(name), num_envs=NUM_ENVS, seed=0)
    sleepless = SafetyGymEnv(resolve(name), num_envs=NUM_ENVS, seed=0, sleep=False)
    tensordict, asleep, awake = env.reset(), [], []
    for actions in forward_driving():
        awake.append(drive(sleepless, sleepless.set_state(env.get_state()), actions)[1])
        tensordict, sums = drive(env, tensordict, actions)
        asleep.append(sums)
    for key in asleep[0]:
        got, want = (np.stack([sums[key] for sums in windows]) for windows in (asleep, awake))
        difference = (got - want).mean(0)  # one number per world, so that they are independent
        bias, error = abs(difference.mean()), stats.sem(difference)
        size = np.abs(want).mean()
        assert bias <= max(3 * error, NEGLIGIBLE * size), (key, bias, error, size)
        if key != "cost_exception":
            assert 3 * error <= TELLING * size, f"{key}: too few events to tell"


@pytest.mark.parametrize(
    "config", ["PointGoal2", "CarPush2", "DoggoGoal2", "PointButton2", SEEN_BY_RAYS]
)
def test_a_step_with_sleeping_objects_is_one_without(config):
    torch.manual_seed(3)
    asleep = SafetyGymEnv(config, num_envs=16, seed=3, num_threads=1)
    awake = SafetyGymEnv(config, num_envs=16, seed=3, num_threads=1, sleep=False)
    asleep.rollout(60, break_when_any_done=False)
    here = awake.set_state(asleep.get_state())
    action = asleep.action_spec.rand()
    got, want = (env.step(here.clone().set("action", action))["next"] for env in (asleep, awake))
    agrees = (got["observation"] - want["observation"]).abs().amax(-1) <= 1e-3
    assert (~agrees).float().mean() <= MOST_CHAOTIC
    for key, bound in ({"reward": 1e-5} | dict.fromkeys(asleep.cost_keys, 0.0)).items():
        assert ((got[key] - want[key]).abs()[agrees] <= bound).all(), key
