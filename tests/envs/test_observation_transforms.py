"""Noisy observations and observed costs: distributions, values worked out by hand."""

import gymnasium
import numpy as np
import pytest
import torch
from scipy.stats import kstest
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from transforming import ENVIRONMENTS, SAUTE, Priced, still, transformed

from safe_rl.envs import check_constrained_env, from_gymnasium, make_env
from safe_rl.envs.transforms import ObservedCosts, Saute, SensorNoise


@pytest.mark.parametrize("env", ["point_mass", "safety_gym"])
def test_noise_is_normal_independent_and_around_what_is_there(env):
    exact, noisy = still(ENVIRONMENTS[env](), 200), still(transformed(env, "noise", seed=0), 200)
    for end in ((), ("next",)):
        draws = (noisy[*end, "observation"] - exact[*end, "observation"]) / 0.5
        assert kstest(draws.flatten(), "norm").pvalue > 1e-3
        rows = draws.flatten(1)
        assert (torch.corrcoef(rows) - torch.eye(len(rows))).abs().max() < 0.1
        assert (torch.corrcoef(draws.flatten(0, 1)[::7].T).fill_diagonal_(0)).abs().max() < 0.6
    # what a step shows is what the next one begins with
    inside = ~noisy["next", "done"][:, :-1, 0]
    first, second = noisy["next", "observation"][:, :-1], noisy["observation"][:, 1:]
    assert torch.equal(first[inside], second[inside])


def test_entries_of_a_dictionary_get_the_noise_of_their_columns():
    keys = {"robot_base": "point", "hazards_num": 2, "observe_hazards": True}
    flat, nested = (
        make_env(given, num_envs=2, seed=0, transforms={"noise": SensorNoise(0.1)})
        for given in (keys, keys | {"observation_flatten": False})
    )
    check_env_specs(nested)
    for env in (flat, nested):
        env.set_seed(0)
    vector, entries = (env.reset()["observation"] for env in (flat, nested))
    for name, columns in flat.observation_layout.items():
        assert torch.equal(entries[name].flatten(1), vector[:, columns]), name


def test_every_episode_draws_the_strength_of_its_noise_from_a_range():
    noisy, exact = (
        make_env("PointGoal1", num_envs=50, seed=0, transforms=named)
        for named in ({"noise": SensorNoise([0.1, 0.3])}, {})
    )
    noise = noisy.reset()["observation"] - exact.reset()["observation"]
    std = noise.std(-1)
    assert 0.07 < std.min() < 0.15 < 0.25 < std.max() < 0.4
    with pytest.raises(ValueError, match=r"std=.*the lowest and the highest value"):
        SensorNoise([0.3, 0.1])


class Film(gymnasium.Env):
    """Observes a picture and nothing else."""

    observation_space = gymnasium.spaces.Box(0, 255, (4, 4, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.full((4, 4, 3), 100, np.uint8), {}

    def step(self, action):
        return np.full((4, 4, 3), 100, np.uint8), 1.0, False, False, {"cost": 1.0}


def test_pictures_have_no_noise_and_no_room_for_budgets():
    film = from_gymnasium(Film, num_envs=2, cost_keys=["cost"], num_steps=4, flatten=False)
    env = transformed(film, noise=SensorNoise(30.0))
    check_env_specs(env)
    assert (env.rollout(6, break_when_any_done=False)["observation"] == 100).all()
    with pytest.raises(ValueError, match="not a dictionary or a picture"):
        check_constrained_env(transformed(film, saute=Saute({"cost": 2.0}, **SAUTE)))


@pytest.mark.parametrize("env", ["point_mass", "safety_gym"])
def test_noise_comes_from_the_seed_and_rows_do_not_share_it(env):
    made = transformed(env, "noise", seed=3)
    first = still(made, 12)["observation"]
    for seed, same in ((3, True), (4, False)):
        torch.manual_seed(9)  # torch's generator has no influence
        again = transformed(env, "noise", seed=seed)
        assert torch.equal(still(again, 12)["observation"], first) == same
    assert (first[0] != first[1]).any()
    if env == "safety_gym":
        made.set_seed(3)
        repeated = still(made, 12)["observation"]
        made.set_seed(3)
        assert torch.equal(still(made, 12)["observation"], repeated)


def test_costs_and_their_traces_are_observed():
    priced = Priced([[1.0, 0.0, 4.0, 0.0]])
    env = transformed(priced, seen=ObservedCosts(0.75, ["cost"]), evaluating=True)
    check_env_specs(env)
    assert env.observation_layout["last_costs"] == slice(4, 5)
    env.set_seed(0)
    seen = still(env, 6)["next", "observation"][0, :, 4:]
    traces = [0.25, 0.1875, 1.140625, 0.85546875, 0.25, 0.1875]
    assert seen.tolist() == [[c, e] for c, e in zip((1, 0, 4, 0, 1, 0), traces, strict=True)]
    everything = TransformedEnv(priced, ObservedCosts(0.5))  # TorchRL's class does not name them
    assert everything.reset()["observation"].shape == (1, 4 + 2 * len(priced.cost_keys))
