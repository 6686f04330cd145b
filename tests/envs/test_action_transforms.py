"""Filtered, delayed and held actions, against single steps of the same environment."""

from functools import partial
from operator import itemgetter

import pytest
import torch
from point_mass import PointMass
from torchrl.data import Bounded, OneHot
from torchrl.envs import ActionScaling, Compose, TransformedEnv
from transforming import ENVIRONMENTS, Priced, still, transformed

from safe_rl.envs import make_env
from safe_rl.envs.transforms import ActionDelay, ActionFilter, ActionRepeat, EarlyTermination
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
