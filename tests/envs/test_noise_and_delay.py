"""Noisy observations and delayed actions: distributions, shifted rollouts, exact snapshots."""

import gymnasium
import numpy as np
import pytest
import torch
from scipy.stats import kstest
from test_transforms import ENVIRONMENTS, still
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import check_constrained_env, from_gymnasium, make_env
from safe_rl.envs.transforms import ActionDelay, Saute, SensorNoise, transform_env

NOISE, DELAY = {"noise": lambda: SensorNoise(0.5)}, {"delay": lambda: ActionDelay(2)}
ENVIRONMENTS = ENVIRONMENTS | {
    "choices": lambda: from_gymnasium("CartPole-v1", num_envs=3, cost_keys=["cost"], seed=0)
}


def changed(env, changes, seed=0):
    made = {name: make() for name, make in changes.items()}
    return transform_env(ENVIRONMENTS[env](), made, evaluating=False, seed=seed)


@pytest.mark.parametrize("changes", [NOISE, DELAY, NOISE | DELAY], ids=["noise", "delay", "both"])
@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_specs_are_true_and_the_contract_is_kept(env, changes):
    env = changed(env, changes)
    check_env_specs(env)
    check_constrained_env(env)
    env.close()


@pytest.mark.parametrize("env", ["point_mass", "safety_gym"])
def test_noise_is_normal_independent_and_around_what_is_there(env):
    exact, noisy = still(ENVIRONMENTS[env](), 200), still(changed(env, NOISE), 200)
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


def test_only_what_is_named_is_noisy_flat_or_not():
    keys = {"robot_base": "point", "hazards_num": 2, "observe_hazards": True}
    named = {"noise": SensorNoise(0.1, ["gyro", "hazards_lidar"])}
    exact = make_env(keys, num_envs=2, seed=0)
    flat = make_env(keys, num_envs=2, seed=0, transforms=named)
    named = {"noise": SensorNoise(0.1, ["gyro", "hazards_lidar"])}
    nested = make_env(
        keys | {"observation_flatten": False}, num_envs=2, seed=0, transforms=named
    )  # fmt: skip
    check_env_specs(nested)
    for env in (exact, flat, nested):
        env.set_seed(0)
    was, now, entries = (env.reset()["observation"] for env in (exact, flat, nested))
    for name, columns in exact.observation_layout.items():
        differs = (was[:, columns] != now[:, columns]).all()
        assert differs == (name in ("gyro", "hazards_lidar")), name
        assert torch.equal(entries[name].flatten(1), now[:, columns]), name


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
    env = transform_env(film, {"noise": SensorNoise(30.0)}, evaluating=False)
    check_env_specs(env)
    assert (env.rollout(6, break_when_any_done=False)["observation"] == 100).all()
    saute = Saute({"cost": 2.0}, discount=0.9, unsafe_reward=-1.0, rescale_budgets=False)
    with pytest.raises(ValueError, match=r"the shape \[2, 4, 4, 3\]: let the environment make"):
        check_constrained_env(transform_env(film, {"saute": saute}, evaluating=False))


@pytest.mark.parametrize("env", ["point_mass", "safety_gym"])
def test_noise_comes_from_the_seed_and_rows_do_not_share_it(env):
    first = still(changed(env, NOISE, seed=3), 12)["observation"]
    for seed, same in ((3, True), (4, False)):
        torch.manual_seed(9)  # nobody's draws but the row's
        again = changed(env, NOISE, seed=seed)
        assert torch.equal(still(again, 12)["observation"], first) == same
    assert (first[0] != first[1]).any()


def test_seeding_an_environment_seeds_its_noise():
    env = changed("safety_gym", NOISE)
    env.set_seed(3)
    first = still(env, 12)["observation"]
    env.set_seed(3)
    assert torch.equal(still(env, 12)["observation"], first)


@pytest.mark.parametrize("env", ["point_mass", "safety_gym"])
def test_a_delay_shifts_actions_and_nothing_else(env):
    torch.manual_seed(1)
    actions = torch.rand(3, 8, 2) * 2 - 1
    early = torch.cat([torch.zeros(3, 2, 2), actions[:, :-2]], 1)

    def play(env, actions):
        left = iter(actions.unbind(1))
        return env.rollout(8, lambda td: td.set("action", next(left)))

    env_, delayed = ENVIRONMENTS[env](), changed(env, DELAY)
    plain, late = play(env_, early), play(delayed, actions)
    assert torch.equal(late["next", "observation"], plain["next", "observation"])
    assert torch.equal(late["action"], actions)  # what is learned from


def test_what_is_pending_ends_with_the_episode_of_its_row():
    env = transform_env(ENVIRONMENTS["point_mass"](), {"delay": ActionDelay(1)}, evaluating=False)
    state = env.reset().set("action", torch.ones(3, 2))
    state = env.step_mdp(env.step(state))
    again = torch.tensor([[True], [False], [False]])
    state = env.reset(state.set("_reset", again)).set("action", torch.zeros(3, 2))
    speed = env.step(state)["next", "observation"][:, 2:4]
    assert (speed[0] == 0).all()
    assert (speed[1:] > 0).all()


@pytest.mark.parametrize(
    ("spec", "nothing"),
    [
        (Bounded(-1.0, 1.0, (3, 2)), [0.0, 0.0]),
        (Bounded(0.5, 1.0, (3, 2)), [0.5, 0.5]),
        (Categorical(4, shape=(3,)), [0]),
        (OneHot(4, shape=(3, 4)), [1, 0, 0, 0]),
    ],
    ids=["around 0", "above 0", "choices", "one-hot"],
)
def test_nothing_is_the_allowed_action_next_to_zero(spec, nothing):
    env = ENVIRONMENTS["point_mass"]()
    env.action_spec = spec
    env = transform_env(env, {"delay": ActionDelay(3)}, evaluating=False)
    env.reset()
    pending = env.transform[0].rows()["pending"]
    assert pending.tolist() == [nothing * 3] * 3


@pytest.mark.parametrize("env", ["point_mass", "safety_gym"])
def test_a_snapshot_goes_on_exactly(env):
    env = changed(env, NOISE | DELAY | {"saute": lambda: Saute(
        {"cost": 2.0}, discount=0.9, unsafe_reward=-1.0, rescale_budgets=False)})  # fmt: skip

    def go_on(state, seed):
        begun = env.set_state(state.clone())
        torch.manual_seed(1)
        return env.rollout(15, auto_reset=False, tensordict=begun, break_when_any_done=False)

    env.rollout(5)
    state = env.get_state()
    first, second = go_on(state, 1), go_on(state, 2)
    for key in ("observation", "reward", "terminated"):
        assert torch.equal(first["next", key], second["next", key])
    assert torch.equal(first["observation"], second["observation"])


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: SensorNoise(-0.1), "std=-0.1"),
        (lambda: SensorNoise(float("nan")), "std=nan"),
        (lambda: ActionDelay(0), "steps=0"),
        (
            lambda: make_env("PointGoal1", transforms={"n": SensorNoise(0.1, ["hazard_lidar"])}),
            r"transforms.n: components: .*Did you mean 'hazards_lidar'",
        ),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
