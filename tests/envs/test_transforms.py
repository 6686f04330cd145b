"""Transforms of constrained problems, against budgets that are counted by hand."""

import math

import pytest
import torch
from point_mass import PointMass
from torchrl.data import Bounded
from torchrl.envs import ActionDiscretizer, TransformedEnv
from torchrl.envs.transforms import StepCounter
from torchrl.envs.utils import check_env_specs
from transforming import (
    ENVIRONMENTS,
    SAUTE,
    SHORT,
    TRANSFORMS,
    Priced,
    half_speed,
    still,
    transformed,
)

from safe_rl.envs import ConstrainedEnv, SafetyGymEnv, check_constrained_env, make_env, rng
from safe_rl.envs.transforms import (
    ActionFilter,
    ActionRepeat,
    ConstraintTransform,
    EarlyTermination,
    ObservedCosts,
    Saute,
    SensorNoise,
)
from safe_rl.trust import TargetError, allow

allow("transforming")


ALL_BUT_SAUTE = tuple(TRANSFORMS)[1:]
READ_EVALUATING = {"saute", "simmer", "early_termination"}
CASES = [
    (env, names)
    for env in ENVIRONMENTS.keys() - {"choices"}
    for names in (*((name,) for name in TRANSFORMS), ALL_BUT_SAUTE)
] + [("choices", ("noise", "delay", "action_repeat"))]


@pytest.mark.parametrize(
    ("env", "names", "evaluating"),
    [
        *((*case, False) for case in sorted(CASES)),
        *((*case, True) for case in sorted(CASES) if READ_EVALUATING & {*case[1]}),
    ],
)
def test_specs_are_true_and_the_contract_is_kept(env, names, evaluating):
    env = transformed(env, *names, evaluating=evaluating)
    check_env_specs(env)
    check_constrained_env(env)
    assert isinstance(env, ConstrainedEnv)
    assert (env.get_state() is None) == (env.base_env.get_state() is None)
    observed = env.observation_spec["observation"]
    if isinstance(observed.shape, torch.Size) and len(observed.shape) == 2:
        assert max(columns.stop for columns in env.observation_layout.values()) == observed.shape[1]
    env.close()


def test_the_budget_is_what_is_left_of_it_by_kind_and_row():
    costs = [[0.0, 1.0, 0.0, 3.0, 0.0], [2.0, 0.0, 0.0, 0.0, 0.0]]
    budgets = {"cost": 4.0, "cost_north": 40.0}
    env = transformed(Priced(costs), saute=Saute(budgets, **SAUTE))
    assert env.observation_layout["budget"] == slice(4, 6)
    assert env.observation_spec["observation"].shape == (2, 6)
    batch = still(env, 7)  # an episode of 5 steps and two of the next one
    shares = torch.tensor(costs).unsqueeze(-1) * torch.tensor([1 / 4, 2 / 40])
    before, after = [], []
    for step in range(7):
        before.append(torch.ones(2, 2) if step in (0, 5) else after[-1])
        after.append((before[-1] - shares[:, step % 5]) / 0.9)
    for seen, left in ((batch, before), (batch["next"], after)):
        torch.testing.assert_close(
            seen["observation"][..., 4:], torch.stack(left, 1), rtol=1e-6, atol=1e-12
        )


def test_rows_that_continue_keep_their_budget_when_others_begin():
    env = transformed(Priced([[1.0] * 9, [1.0] * 9]), "saute")
    state = still(env, 1)[:, -1]["next"].select("observation")
    begun = env.reset(state.set("_reset", torch.tensor([[True], [False]])))
    after_one = (1 - 1 / 2) / 0.9
    assert begun["observation"][:, -1].tolist() == pytest.approx([1.0, after_one])
    # TorchRL keeps the entries of rows that continue, whatever the transform has
    later = env.step(begun.set("action", torch.zeros(2, 2)))["next", "observation"][:, -1]
    assert later.tolist() == pytest.approx([after_one, (after_one - 1 / 2) / 0.9])


def test_a_spent_budget_replaces_the_reward_and_the_own_one_is_kept():
    costs = [[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.9999]]
    plain = still(Priced(costs), 4)
    budgets = {"cost": 2.0, "cost_north": 40.0}  # one that is spent is enough
    saute = Saute(budgets, discount=1.0, unsafe_reward=-3.0, rescale_budgets=False)
    env = transformed(Priced(costs), saute=saute)
    batch = still(env, 4)
    assert env.return_key == "task_reward"
    assert torch.equal(batch["next", "task_reward"], plain["next", "reward"])
    expected = plain["next", "reward"].clone()
    expected[0, 1:] = -3.0
    assert torch.equal(batch["next", "reward"], expected)
    # a step does not keep the reward that the last one has left in its TensorDict
    again = env.step(env.step(env.reset().set("action", torch.full((2, 2), -0.5))))["next"]
    assert torch.equal(again["task_reward"][1], again["reward"][1])


class Doubled(ConstraintTransform):
    return_key = "task_reward"

    def _step(self, tensordict, next_tensordict):
        reward = next_tensordict["reward"]
        return next_tensordict.update({"task_reward": reward, "reward": 2 * reward})


def test_the_first_of_several_that_change_the_reward_keeps_the_own_one():
    costs = [[0.0, 0.0, 9.0, 0.0]]
    own = still(Priced(costs), 4, -0.5)["next", "reward"]
    env = transformed(Priced(costs), doubled=Doubled(), saute=Saute({"cost": 2.0}, **SAUTE))
    batch = still(env, 4, -0.5)["next"]
    assert torch.equal(batch["task_reward"], own)
    assert torch.equal(batch["reward"][:, :2], 2 * own[:, :2])
    assert (batch["reward"][:, 2:] == -1.0).all()


def test_the_constant_reward_may_be_outside_the_bounds_of_the_own_one():
    env = PointMass(1)
    rewards = env.full_reward_spec.clone()
    rewards["reward"] = Bounded(0, 1, (1, 1))
    env.full_reward_spec = rewards
    spec = transformed(env, "saute").full_reward_spec
    assert spec["reward"].is_in(torch.tensor([[SAUTE["unsafe_reward"]]]))


@pytest.mark.parametrize("cost", [1.0, 0.1, 0.7])
@pytest.mark.parametrize("number", [3, 10, 25])
def test_a_budget_is_spent_by_as_many_steps_as_it_has_costs(number, cost):
    """Tenths are not exact in binary numbers, and sums of them less so."""
    budgets, costs = {"cost": number * cost}, [[cost] * 30]
    saute = Saute(budgets, discount=1.0, unsafe_reward=-3.0, rescale_budgets=False)
    spent = still(transformed(Priced(costs), saute=saute), 30)["next", "reward"][0, :, 0] == -3.0
    assert spent.nonzero()[:, 0].tolist() == list(range(number - 1, 30))
    ends = still(transformed(Priced(costs), end=EarlyTermination(budgets)), 30)["next", "done"]
    assert ends.nonzero()[0, 1] == number  # one step later: the cost has to exceed the budget


def test_evaluation_observes_the_budget_and_leaves_the_reward_alone():
    costs = [[1.0, 1.5, 0.0, 0.0]]
    batch = still(transformed(Priced(costs), "saute", evaluating=True), 4)
    assert torch.equal(batch["next", "reward"], still(Priced(costs), 4)["next", "reward"])
    assert batch["next", "observation"][0, 1, -1] < 0


def test_a_rescaled_budget_is_spent_by_costs_that_are_spread_over_the_episode():
    saute = Saute({"cost": 25.0}, discount=0.9, unsafe_reward=-1.0, rescale_budgets=True)
    batch = still(transformed(Priced([[2.5] * 10]), saute=saute), 10)  # costs 25 in all
    left = batch["next", "observation"][0, :, -1]
    assert left[-1].item() == pytest.approx(0.0, abs=1e-6)
    assert (left[:-1] > 0.01).all()
    assert (batch["next", "reward"][0, :-1] != -1).all()


def test_the_budget_of_simmer_grows_from_episode_to_episode():
    env = transformed(Priced([[0.5] * 4]), "simmer")
    env.continue_from(0)
    begins = still(env, 24)["observation"][0, ::4, -1]
    assert begins.tolist() == pytest.approx([0.25, 0.4375, 0.625, 0.8125, 1.0, 1.0])
    for repeat in ({}, {"repeat": ActionRepeat(2)}):
        again = transformed(Priced([[0.5] * 4]), "simmer", **repeat)
        for steps, share in ((8, 0.625), (12, 0.8125)):  # before the first reset, and after it
            again.continue_from(steps)
            assert again.steps_before == steps
            assert again.reset()["observation"][0, -1].item() == pytest.approx(share)
    solved = transformed(Priced([[0.5] * 4]), "simmer", evaluating=True)
    assert solved.reset()["observation"][0, -1].item() == 1.0


def test_the_episode_ends_when_more_than_the_budget_is_spent():
    costs = [[1.0, 1.0, 0.5, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 2.0001], [0.0] * 6]
    end = EarlyTermination({"cost": 2.0, "cost_north": 40.0})  # one that is spent is enough
    late = EarlyTermination({"cost": 100.0})  # leaves the ends of the other one
    batch = still(transformed(Priced(costs), end=end, late=late), 6)["next"]
    terminated, truncated = batch["terminated"].squeeze(-1), batch["truncated"].squeeze(-1)
    # the first row begins anew, with its own costs, and ends again
    assert terminated.nonzero().tolist() == [[0, 2], [0, 5], [1, 5]]
    assert truncated.nonzero().tolist() == [[2, 5]]
    assert torch.equal(batch["done"], batch["terminated"] | batch["truncated"])


@pytest.mark.parametrize(("in_evaluation", "ends"), [(False, []), (True, [1, 3, 5])])
def test_episodes_of_an_evaluation_are_whole_unless_they_are_to_end_too(in_evaluation, ends):
    end = EarlyTermination({"cost": 5.0}, in_evaluation=in_evaluation)
    batch = still(transformed(Priced([[3.0] * 6]), end=end, evaluating=True), 6)["next"]
    assert batch["terminated"].squeeze().nonzero()[:, 0].tolist() == ends
    assert batch["done"].squeeze().nonzero()[:, 0].tolist() == (ends or [5])


@pytest.mark.parametrize(
    ("evaluating", "in_evaluation", "highest"),
    [(False, False, 3.0), (True, False, 8.0), (True, True, 3.0)],
)
def test_no_episode_costs_more_than_the_budget_and_a_step_where_it_ends_by_it(
    evaluating, in_evaluation, highest
):
    end = EarlyTermination({"cost": 2.0}, in_evaluation=in_evaluation)
    assert transformed("safety_gym", evaluating=evaluating, end=end).highest_cost("cost") == highest


def test_a_state_without_a_transform_begins_its_episode():
    env = transformed(PointMass(2), "saute")
    env.rollout(1)
    state = env.get_state()
    state["transforms", "saute", "budget"][:] = 0.25
    assert (env.set_state(state)["observation"][:, -1] == 0.25).all()
    assert (env.set_state(state.exclude("transforms"))["observation"][:, -1] == 1).all()


def test_a_state_shares_no_memory_with_the_environment():
    env = transformed(Priced([[0.5] * 9]), "saute")
    still(env, 1)
    budget = ("transforms", "saute", "budget")
    left = (1 - 0.5 / 2) / 0.9
    state = env.get_state()
    for change in (lambda: None, lambda: env.set_state(state.set(budget, state[budget] + left))):
        change()
        state[budget].zero_()
        assert env.get_state()[budget].item() == pytest.approx(left)
    begun = env.set_state(env.get_state())
    assert begun["observation"][0, -1].item() == pytest.approx(left)


def test_what_stands_outside_keeps_the_returns_and_decisions_of_what_is_inside():
    env = transformed(PointMass(1), "saute", "noise", repeat=ActionRepeat(4))
    outer = transformed(env, late=SensorNoise(0.1))
    assert (outer.return_key, outer.steps_per_decision) == ("task_reward", 4)
    assert transformed(PointMass(1), "saute", "noise").return_key == "task_reward"


@pytest.mark.parametrize(
    "name",
    [
        *("max_episode_steps", "seconds_per_step", "events", "sensor_keys", "privileged_layout"),
        *("reuses_tensors", "steps_after_end", "get_positions", "render"),
    ],
)
def test_what_no_transform_changes_is_that_of_the_inner_environment(name):
    seeing = {"hazards_num": 1, "observe_hazards": True, "observe_privileged": True}
    env = transformed(SafetyGymEnv(SHORT | seeing, 1, seed=0), "noise")
    inner = getattr(env.base_env, name)
    assert getattr(env, name) == inner != getattr(ConstrainedEnv, name, None)


def test_transforms_do_not_share_their_draws():
    exact, noisy = PointMass(4000), PointMass(4000)
    noisy = transformed(noisy, one=SensorNoise(0.3), other=SensorNoise(0.4), seed=0)
    noise = noisy.reset()["observation"] - exact.reset()["observation"]
    assert noise.std().item() == pytest.approx(0.5, rel=0.05)  # shared ones: 0.7


def test_transforms_do_not_get_the_seeds_of_episodes():
    env = transformed(PointMass(1), one=SensorNoise(0.1), other=SensorNoise(0.1), seed=3)
    env.reset()
    episodes = rng.fold(rng.row_seeds(3, 1), torch.arange(100))  # as the environments do
    for noise in env.get_state()["transforms"].values():
        assert not (noise["key"] == episodes).any()


def test_transforms_of_torchrl_can_stand_among_ours():
    env = transformed(PointMass(2), "saute", count=StepCounter())
    check_env_specs(env)
    # what TorchRL's transforms store is in no state
    assert env.get_state() is None
    for add in (TransformedEnv.append_transform, lambda env, t: env.insert_transform(0, t)):
        env = transformed(PointMass(2), "saute", "noise")
        assert env.get_state() is not None
        assert add(env, StepCounter()) is env
        env.set_seed(0)
        assert env.rollout(3)["next", "step_count"][0, :, 0].tolist() == [1, 2, 3]
        assert env.highest_cost("cost") == transformed(PointMass(2), "saute").highest_cost("cost")
        assert env.get_state() is None


@pytest.mark.parametrize("env", ["gymnasium", "safety_gym"])
def test_actions_at_random_are_those_that_the_transforms_take(env):
    discrete = transformed(env, units=ActionDiscretizer(3))
    actions = discrete.rollout(20)["action"]
    assert discrete.action_spec.is_in(actions[:, 0])
    assert actions.unique().numel() > 1


def test_nodes_are_built_and_their_keys_named():
    node = {
        "_target_": "safe_rl.envs.transforms.ActionFilter",
        "filter": {"_target_": "transforming.half_speed", "_partial_": True, "speed": 0.1},
    }
    env = make_env({"robot_base": "point"}, num_envs=2, seed=0, transforms={"slow": node})
    torch.manual_seed(0)
    assert env.rollout(4)["next", "cost_interventions"].all()
    wrong = {**node, "filter": {"_target_": "transforming.half_spe", "_partial_": True}}
    with pytest.raises(TargetError, match=r"transforms\.slow\.filter\._target_=.*half_spe"):
        make_env({"robot_base": "point"}, transforms={"slow": wrong})
    misspelt = {**node, "filter": {**node["filter"], "sped": 0.1}}
    with pytest.raises(ValueError, match=r"^transforms\.slow: .*unexpected .*'sped'"):
        make_env({"robot_base": "point"}, transforms={"slow": misspelt})
    late = {"_target_": "safe_rl.envs.transforms.ActionDelay", "steps": -1}
    with pytest.raises(ValueError, match=r"^transforms\.late\.steps=-1: it must be"):
        make_env("PointGoal1", transforms={"late": late})
    with pytest.raises(TypeError, match="transforms must be a mapping"):
        make_env("PointGoal1", transforms=["action_repeat"])
    with pytest.raises(TargetError, match=r"^transforms\.n: .* Use model\.normalise=10"):
        make_env("PointGoal1", transforms={"n": {"_target_": "transforming.normed"}})


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Saute({}, **SAUTE), "budgets={}: .*at least 1 item"),
        (lambda: Saute({"cost": 0.0}, **SAUTE), "greater than 0"),
        (lambda: EarlyTermination({"cost": math.nan}), "a finite number"),
        (lambda: ActionRepeat(0), "k=0: it must be greater"),
        (lambda: transformed(PointMass(1), "saute", "simmer"), "one of saute and simmer"),
        (
            lambda: transformed("dictionary", o=ObservedCosts(0.5)).observation_spec,
            "observed_costs adds columns",
        ),
        *(
            (lambda t=t: TransformedEnv(PointMass(1), t).rollout(1), "no cost 'coast'")
            for t in (ObservedCosts(0.5, ["coast"]), EarlyTermination({"coast": 5.0}))
        ),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize(
    ("transforms", "words"),
    [
        ({"f": ActionFilter(lambda step: torch.ones(1, 1))}, r"shape \(1, 2\), got \(1, 1\)"),
        ({"f": ActionFilter(lambda step, positions: positions)}, "parameter 'positions'"),
        *(
            ({"f": ActionFilter(half_speed, cost_key=key)}, f"f: cost_key={key}: choose another")
            for key in ("cost", "cost_north", "reward")
        ),
        ({"r": ActionRepeat(2), "o": ObservedCosts(0.5)}, r"'r' has to be the last one.*=\[o,r\]"),
        ({"a": ActionRepeat(2), "b": ActionRepeat(3)}, "'a' and 'b' hold actions: choose one"),
        ({"o": ObservedCosts(0.5, ["coast"])}, "o: There is no cost 'coast'"),
        ({"e": EarlyTermination({"coast": 5.0})}, "e: There is no cost 'coast'"),
        ({"s": Saute({"coast": 5.0}, **SAUTE)}, "s: There is no cost 'coast'"),
    ],
)
def test_transforms_that_do_not_fit_are_refused(transforms, words):
    with pytest.raises(ValueError, match=words):
        transformed(PointMass(1), **transforms).rollout(1)
