"""Noisy observations, observed costs, and filtered, delayed and held actions, step by step."""

from functools import partial
from operator import itemgetter

import gymnasium
import numpy as np
import pytest
import torch
from point_mass import PointMass
from scipy.stats import kstest
from torchrl.data import Bounded, OneHot
from torchrl.envs import ActionScaling, Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs
from transforming import ENVIRONMENTS, SAUTE, Priced, still, transformed

from safe_rl.envs import check_constrained_env, from_gymnasium, make_env
from safe_rl.envs.transforms import (
    ActionDelay,
    ActionFilter,
    ActionRepeat,
    EarlyTermination,
    ObservedCosts,
    Saute,
    SensorNoise,
)
from safe_rl.evaluation.episodes import collect_episodes


@pytest.mark.parametrize("clamp", [torch.clamp, torch.clamp_])
def test_replaced_actions_are_taken_and_counted_and_the_chosen_ones_kept(clamp):
    env = transformed(PointMass(2), f=ActionFilter(lambda step: clamp(step["action"], -0.5, 0.5)))
    assert env.cost_keys == [*PointMass.cost_keys, "cost_interventions"]
    assert env.highest_cost("cost_interventions") == env.max_episode_steps
    chosen = torch.tensor([[0.2, -0.2], [0.2, 0.9]])
    step = env.step(env.reset().set("action", chosen.clone()))
    assert torch.equal(step["action"], chosen)
    assert step["next", "cost_interventions"].squeeze(-1).tolist() == [0.0, 1.0]
    moved = step["next", "observation"][:, 2:4]
    torch.testing.assert_close(moved, 0.15 * torch.tensor([[0.2, -0.2], [0.2, 0.5]]))


def test_a_filter_gets_the_positions_before_the_step_and_the_layout_if_it_asks_for_them():
    seen = []

    def shield(step, positions, layout, part="robot"):
        seen.append((positions[part], step["observation"], layout))
        return step["action"]

    node = {"_target_": "safe_rl.envs.transforms.ActionFilter", "filter": partial(shield)}
    env = make_env("PointGoal1", num_envs=2, seed=0, transforms={"f": node})
    state = env.reset()
    for _ in range(3):
        # the joints of a planar robot are the position of its body
        xy = env.get_state()["qpos"][:, :2]
        state["action"] = torch.ones(2, 2)
        state = env.step(state)["next"].exclude("reward")
        torch.testing.assert_close(seen[-1][0][:, 0, :2], xy, rtol=0, atol=1e-9)
    assert seen[-1][2] == env.observation_layout
    assert not torch.equal(seen[0][0], seen[-1][0])


def play(env, actions):
    """A rollout with given actions [N, T, A], over the ends of episodes."""
    left = iter(actions.unbind(1))
    return env.rollout(
        actions.shape[1], lambda td: td.set("action", next(left)), break_when_any_done=False
    )


@pytest.mark.parametrize("env", ["point_mass", "safety_gym"])
def test_a_delay_shifts_actions_and_nothing_else(env):
    actions = torch.rand(3, 8, 2) * 2 - 1
    early = torch.cat([torch.zeros(3, 2, 2), actions[:, :-2]], 1)
    plain, late = play(ENVIRONMENTS[env](), early), play(transformed(env, "delay"), actions)
    assert torch.equal(late["next", "observation"], plain["next", "observation"])
    assert torch.equal(late["action"], actions)  # what is learned from


def test_a_delay_inside_other_units_begins_with_what_the_environment_takes_for_nothing():
    units = ActionScaling(loc=-3.0, scale=1.0)  # policies act in [2, 4]
    env = transformed(PointMass(1), delay=ActionDelay(1), units=units)
    state = env.step(env.reset().set("action", torch.full((1, 2), 4.0)))
    assert (state["next", "observation"][:, 2:4] == 0).all()


def test_a_filter_may_work_in_place_on_what_it_gets():
    def shield(step):
        step["observation"].zero_()
        return step["action"]

    env = transformed(PointMass(2), f=ActionFilter(shield))
    start = env.reset()
    step = env.step(start.clone().set("action", torch.ones(2, 2)))
    assert start["observation"].any()
    assert torch.equal(step["observation"], start["observation"])


def test_a_filter_without_a_signature_gets_the_step():
    env = transformed(PointMass(2), f=ActionFilter(itemgetter("action")))
    assert (env.rollout(2)["next", "cost_interventions"] == 0).all()


class Choosing(PointMass):
    """Stays where it is, whichever of three actions is chosen, and notes it."""

    def __init__(self):
        super().__init__(2)
        self.action_spec, self.taken = OneHot(3, shape=(2, 3)), []

    def _step(self, tensordict):
        self.taken.append(tensordict["action"].long().tolist())
        return super()._step(tensordict.clone().set("action", torch.zeros(2, 2)))


def test_a_delay_of_choices_begins_with_the_first():
    env = Choosing()
    late = transformed(env, delay=ActionDelay(1))
    late.step(late.reset().set("action", torch.tensor([[0, 0, 1], [0, 0, 1]])))
    assert env.taken == [[[1, 0, 0], [1, 0, 0]]]


def test_what_is_pending_ends_with_the_episode_of_its_row():
    env = transformed("point_mass", delay=ActionDelay(1))
    state = env.reset().set("action", torch.ones(3, 2))
    state = env.step_mdp(env.step(state))
    again = torch.tensor([[True], [False], [False]])
    state = env.reset(state.set("_reset", again)).set("action", torch.zeros(3, 2))
    speed = env.step(state)["next", "observation"][:, 2:4]
    assert (speed[0] == 0).all()
    assert (speed[1:] > 0).all()


@pytest.mark.parametrize("k", [1, 3, 4])
def test_sums_are_those_of_single_steps_over_several_episodes(k):
    # of episodes of 10 steps, repeats of 3 and 4 reach beyond the end
    keys = {"num_steps": 10, "goal_size": 1.0, "hazards_keepout": 0.0, "hazards_size": 0.6}
    single, env = (make_env("PointGoal1", num_envs=3, seed=1, **keys) for _ in range(2))
    env = transformed(env, repeat=ActionRepeat(k))
    decisions = -(-10 // k)
    held = env.rollout(2 * decisions, break_when_any_done=False)
    taken = held["next", "steps_taken"][..., 0] if k > 1 else torch.ones(3, 20, dtype=torch.int64)
    assert taken.sum(1).tolist() == [20, 20, 20]
    state = single.reset()
    for number in range(2 * decisions):
        after = held["next"][:, number]
        sums = dict.fromkeys(("reward", *env.cost_keys, "goal_met"), torch.zeros(3, 1))
        for _ in range(int(taken[0, number])):
            state["action"] = held["action"][:, number]
            step, state = single.step_and_maybe_reset(state)
            sums = {key: total + step["next", key] for key, total in sums.items()}
        sums["goal_met"] = sums["goal_met"] > 0
        for key, total in sums.items():
            assert torch.equal(after[key], total), key
        for key in ("observation", "done", "truncated"):
            assert torch.equal(after[key], step["next", key]), key
    assert held["next", "cost"].sum() > 0
    assert held["next", "goal_met"].any()


def test_a_row_that_ends_inside_a_repeat_stops_alone():
    costs = [[1.0, 2.0, 0.0, 4.0, 8.0, 16.0, 32.0, 64.0], [0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0]]
    end = EarlyTermination({"cost": 2.5})
    env = transformed(Priced(costs), end=end, repeat=ActionRepeat(4))
    steps = still(env, 2)["next"]
    assert steps["cost"][..., 0].tolist() == [[3.0, 3.0], [1.0, 1.0]]
    assert steps["cost_north"][..., 0].tolist() == [[6.0, 6.0], [2.0, 2.0]]
    assert steps["steps_taken"][..., 0].tolist() == [[2, 2], [4, 4]]
    assert steps["terminated"][..., 0].tolist() == [[True, True], [False, False]]
    assert steps["truncated"][..., 0].tolist() == [[False, False], [False, True]]
    assert (env.max_episode_steps, env.steps_per_decision) == (8, 4)
    # rows of a stateless environment, of which one goes on
    node = {"_target_": "safe_rl.envs.torchrl.make_torchrl", "id": "PendulumEnv", "num_steps": 8}
    node["outside"] = {"cost_fast": ["thdot", -2, 2]}
    single, env = (make_env(node, num_envs=3, seed=1) for _ in range(2))
    env = transformed(env, end=EarlyTermination({"cost": 0.0}), repeat=ActionRepeat(4))
    held, steps = still(env, 1)["next"], still(single, 4)["next"]
    assert held["steps_taken"].flatten().tolist() == [2, 4, 3]
    assert torch.equal(held["observation"][1, -1], steps["observation"][1, -1])


def test_an_action_that_is_held_for_one_step_stands_beside_other_transforms():
    env = transformed(PointMass(2), late=ActionDelay(2), repeat=ActionRepeat(1))
    assert (still(env, 3)["next", "steps_taken"] == 1).all()


def test_bounds_of_sums_allow_for_a_last_decision_of_fewer_steps():
    env = PointMass(1)
    rewards = env.full_reward_spec.clone()
    rewards["reward"] = Bounded(torch.ones(1, 1), 2 * torch.ones(1, 1))
    env.full_reward_spec = rewards
    spec = transformed(env, repeat=ActionRepeat(3)).full_reward_spec["reward"]
    assert (spec.low.item(), spec.high.item()) == (1.0, 6.0)


class Refusing(PointMass):
    """A row that has ended takes no step."""

    def _step(self, tensordict):
        assert (self._step_count < self.max_episode_steps).all()
        return super()._step(tensordict)


def test_rows_that_have_ended_begin_anew_where_they_could_not_step():
    env = transformed(Refusing(2), repeat=ActionRepeat(4))
    env.reset()
    state = env.get_state()
    state["step_count"][0] = env.max_episode_steps - 2
    step = env.step(env.set_state(state).set("action", torch.zeros(2, 2)))["next"]
    assert step["steps_taken"].flatten().tolist() == [2, 4]
    assert step["done"].flatten().tolist() == [True, False]


def test_episodes_of_a_row_do_not_depend_on_other_rows():
    actions, found = 2 * torch.rand(4, 60, 3) - 1, []
    for rows in (4, 1):
        env = make_env("SafeHopperVelocity", num_envs=rows, seed=0)
        env = transformed(env, "noise", repeat=ActionRepeat(4), seed=0)
        seen = play(env, actions[:rows])["observation"][0]
        found.append((seen, env.get_state()["episode"][0]))
    (seen, episode), (alone, one) = found
    assert episode == one > 5
    assert torch.equal(seen, alone)


@pytest.mark.parametrize("other", [ActionDelay(2), EarlyTermination({"cost": 2.0})])
def test_others_beside_a_repeat_would_act_once_per_decision_and_are_refused(other):
    env = TransformedEnv(PointMass(2), Compose(other, ActionRepeat(4)))
    with pytest.raises(ValueError, match=rf"{type(other).__name__} must act .*make_env\("):
        env.reset()


def test_evaluation_counts_steps_of_the_environment():
    costs = [[1.0] * 10, [0.0] * 10]
    env = transformed(Priced(costs), repeat=ActionRepeat(4))
    found = collect_episodes(
        env, lambda td: td.set("action", torch.zeros(2, 2)), 4, ["cost"], deterministic=True
    )
    assert found.lengths.tolist() == [10.0] * 4
    assert found.costs["cost"].tolist() == [10.0, 10.0, 0.0, 0.0]


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
