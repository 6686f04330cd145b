"""Transforms of constrained problems, against budgets that are counted by hand."""

import math
import re
from functools import partial

import gymnasium_envs  # noqa: F401, registers Walk-v0
import pytest
import torch
from point_mass import PointMass
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import RewardScaling, StepCounter
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import (
    ConstrainedEnv,
    SafetyGymEnv,
    check_constrained_env,
    from_gymnasium,
    make_env,
)
from safe_rl.envs.transforms import (
    ActionFilter,
    ConstraintTransform,
    EarlyTermination,
    RewardScale,
    Saute,
    Simmer,
    transform_env,
)
from safe_rl.envs.transforms.base import costs_of
from safe_rl.targets import TargetError, allow

allow("test_transforms")
SAUTE = {"discount": 0.9, "unsafe_reward": -1.0, "rescale_budgets": False}


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
    "simmer": lambda: Simmer({"cost": 2.0}, first=0.25, steps=16, **SAUTE),
    "early_termination": lambda: EarlyTermination({"cost": 2.0}),
    "action_filter": lambda: ActionFilter(half_speed),
    "reward_scale": lambda: RewardScale(0.5),
}
ENVIRONMENTS = {
    "point_mass": lambda: PointMass(3),
    "safety_gym": lambda: SafetyGymEnv({"robot_base": "point", "num_steps": 8}, 3, seed=0),
    "dictionary": lambda: SafetyGymEnv(
        {"robot_base": "point", "num_steps": 8, "observation_flatten": False}, 3, seed=0
    ),
    "gymnasium": lambda: from_gymnasium("Walk-v0", num_envs=3, cost_keys=["fast"], seed=0),
}


def transformed(env, *names, evaluating=False):
    return transform_env(env, {name: TRANSFORMS[name]() for name in names}, evaluating=evaluating)


def still(env, steps, action=0.0):
    """Rollout of a point that does nothing, over the ends of episodes."""
    chosen = torch.full((*env.batch_size, 2), action)
    return env.rollout(steps, lambda td: td.set("action", chosen), break_when_any_done=False)


def rewards_of(env, steps=6):
    """What a point earns that moves, [N, T, 1] by entry."""
    return still(env, steps, action=-0.5)["next"]


@pytest.mark.parametrize("evaluating", [False, True])
@pytest.mark.parametrize("names", [*[(n,) for n in TRANSFORMS], (*TRANSFORMS,)[1:]])
@pytest.mark.parametrize("env", ENVIRONMENTS)
def test_specs_are_true_and_the_contract_is_kept(env, names, evaluating):
    env = transformed(ENVIRONMENTS[env](), *names, evaluating=evaluating)
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
    env = transform_env(Priced(costs), {"saute": Saute(budgets, **SAUTE)}, evaluating=False)
    assert env.observation_layout["budget"] == slice(4, 6)
    batch = still(env, 7)  # an episode of 5 steps and two of the next one
    for row in range(2):
        for column, (factor, d) in enumerate([(1, 4.0), (2, 40.0)]):
            z, after = 1.0, []
            for step in range(7):
                if step == 5:
                    z = 1.0
                assert batch["observation"][row, step, 4 + column].item() == pytest.approx(z)
                z = (z - factor * costs[row][step % 5] / d) / 0.9
                after.append(z)
            found = batch["next", "observation"][row, :, 4 + column]
            assert found.tolist() == pytest.approx(after)


def test_rows_that_go_on_keep_their_budget_when_others_begin():
    env = transformed(Priced([[1.0] * 9, [1.0] * 9]), "saute")
    batch = still(env, 1)
    state = batch[:, -1]["next"].select("observation").set(
        "_reset", torch.tensor([[True], [False]])
    )  # fmt: skip
    begun = env.reset(state)
    assert begun["observation"][:, -1].tolist() == pytest.approx([1.0, (1 - 1 / 2) / 0.9])


def test_a_spent_budget_replaces_the_reward_and_the_own_one_is_kept():
    costs = [[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.9]]
    plain = still(Priced(costs), 4)
    budgets = {"cost": 2.0, "cost_north": 40.0}  # one that is spent is enough
    saute = Saute(budgets, discount=1.0, unsafe_reward=-3.0, rescale_budgets=False)
    env = transform_env(Priced(costs), {"saute": saute}, evaluating=False)
    batch = still(env, 4)
    assert env.return_key == "task_reward"
    assert torch.equal(batch["next", "task_reward"], plain["next", "reward"])
    expected = plain["next", "reward"].clone()
    expected[0, 1:] = -3.0
    assert torch.equal(batch["next", "reward"], expected)


@pytest.mark.parametrize("budget", [3, 10, 25])
def test_a_budget_is_spent_by_as_many_steps_as_it_has_costs(budget):
    """A tenth, taken ten times from one, leaves more than nothing in binary numbers."""
    saute = Saute({"cost": budget}, discount=1.0, unsafe_reward=-3.0, rescale_budgets=False)
    env = transform_env(Priced([[1.0] * 30]), {"saute": saute}, evaluating=False)
    spent = still(env, 30)["next", "reward"][0, :, 0] == -3.0
    assert spent.nonzero()[:, 0].tolist() == list(range(budget - 1, 30))


def test_evaluation_observes_the_budget_and_leaves_the_reward_alone():
    costs = [[1.0, 1.5, 0.0, 0.0]]
    env = transformed(Priced(costs), "saute", evaluating=True)
    batch = still(env, 4)
    assert torch.equal(batch["next", "reward"], still(Priced(costs), 4)["next", "reward"])
    assert batch["next", "observation"][0, 1, -1] < 0


def test_a_scaled_reward_is_torchrls_and_returns_are_the_own_ones():
    costs = [[0.0] * 6] * 2
    own = rewards_of(Priced(costs))["reward"]
    assert (own != 0).all()
    env = transform_env(Priced(costs), {"scale": RewardScale(0.25)}, evaluating=False)
    batch = rewards_of(env)
    theirs = rewards_of(TransformedEnv(Priced(costs), RewardScaling(0.0, 0.25)))
    torch.testing.assert_close(batch["reward"], theirs["reward"])
    assert torch.equal(batch[env.return_key], own)
    solved = transform_env(Priced(costs), {"scale": RewardScale(0.25)}, evaluating=True)
    assert torch.equal(rewards_of(solved)["reward"], own)


@pytest.mark.parametrize(("first", "spent"), [("saute", -1.5), ("scale", -3.0)])
def test_the_own_reward_is_kept_through_several_changes(first, spent):
    costs = [[1.0, 1.0, 0.0, 0.0]]
    own = rewards_of(Priced(costs), 4)["reward"]
    saute = Saute({"cost": 2.0}, discount=1.0, unsafe_reward=-3.0, rescale_budgets=False)
    both = {"saute": saute, "scale": RewardScale(0.5)}
    named = {first: both.pop(first), **both}
    batch = rewards_of(transform_env(Priced(costs), named, evaluating=False), 4)
    expected = torch.cat([0.5 * own[:, :1], torch.full_like(own[:, 1:], spent)], 1)
    torch.testing.assert_close(batch["reward"], expected)
    assert torch.equal(batch["task_reward"], own)


def test_a_rescaled_budget_is_spent_by_costs_that_are_spread_over_the_episode():
    env = Priced([[2.5] * 10])  # 25 in all
    saute = Saute({"cost": 25.0}, discount=0.9, unsafe_reward=-1.0, rescale_budgets=True)
    batch = still(transform_env(env, {"saute": saute}, evaluating=False), 10)
    left = batch["next", "observation"][0, :, -1]
    assert left[-1].item() == pytest.approx(0.0, abs=1e-6)
    assert (left[:-1] > 0.01).all()
    assert (batch["next", "reward"][0, :-1] != -1).all()


def test_the_budget_of_simmer_grows_from_episode_to_episode():
    env = transformed(Priced([[0.5] * 4]), "simmer")
    env.continue_from(0)
    begins = still(env, 24)["observation"][0, ::4, -1]
    assert begins.tolist() == pytest.approx([0.25, 0.4375, 0.625, 0.8125, 1.0, 1.0])
    again = transformed(Priced([[0.5] * 4]), "simmer")
    again.continue_from(8)
    assert again.reset()["observation"][0, -1].item() == pytest.approx(0.625)
    solved = transformed(Priced([[0.5] * 4]), "simmer", evaluating=True)
    assert solved.reset()["observation"][0, -1].item() == 1.0


def test_the_schedule_goes_on_where_workers_take_it_up():
    env = transformed(Priced([[0.5] * 4, [0.5] * 4]), "simmer")
    env.continue_from(8)
    env.reset()
    share = transformed(Priced([[0.5] * 4]), "simmer")
    share.set_state(env.get_state().chunk(2)[1])
    assert share.reset()["observation"][0, -1].item() == pytest.approx(0.625)


def test_the_episode_ends_when_more_than_the_budget_is_spent():
    costs = [[1.0, 1.0, 0.5, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 2.1], [0.0] * 6]
    end = EarlyTermination({"cost": 2.0, "cost_north": 40.0})  # one that is spent is enough
    batch = still(transform_env(Priced(costs), {"end": end}, evaluating=False), 6)["next"]
    terminated, truncated = batch["terminated"].squeeze(-1), batch["truncated"].squeeze(-1)
    # the first row begins anew, with its own costs, and ends again
    assert terminated.nonzero().tolist() == [[0, 2], [0, 5], [1, 5]]
    assert truncated.nonzero().tolist() == [[2, 5]]
    assert torch.equal(batch["done"], batch["terminated"] | batch["truncated"])


def test_episodes_of_an_evaluation_are_whole():
    env = transformed(Priced([[3.0] * 6]), "early_termination", evaluating=True)
    batch = still(env, 6)["next"]
    assert not batch["terminated"].any()
    assert batch["done"].squeeze().tolist() == [False] * 5 + [True]


def test_episodes_of_an_evaluation_end_too_where_that_is_asked_for():
    switch = EarlyTermination({"cost": 5.0}, in_evaluation=True)
    env = transform_env(Priced([[3.0] * 6]), {"switch": switch}, evaluating=True)
    batch = still(env, 6)["next"]
    assert batch["terminated"].squeeze().tolist() == [False, True] * 3


def test_replaced_actions_are_taken_and_counted_and_the_chosen_ones_kept():
    env = transformed(PointMass(2), "action_filter")
    assert env.cost_keys == [*PointMass.cost_keys, "cost_interventions"]
    chosen = torch.tensor([[0.2, -0.2], [0.2, 0.9]])
    step = env.step(env.reset().set("action", chosen))
    assert torch.equal(step["action"], chosen)
    assert step["next", "cost_interventions"].squeeze(-1).tolist() == [0.0, 1.0]
    moved = step["next", "observation"][:, 2:4]
    torch.testing.assert_close(moved, 0.15 * torch.tensor([[0.2, -0.2], [0.2, 0.5]]))


def test_a_filter_may_change_actions_in_place():
    env = PointMass(2)
    in_place = transform_env(
        env, {"f": ActionFilter(lambda step: step["action"].mul_(0.5))}, evaluating=False
    )
    chosen = torch.ones(2, *env.action_spec.shape[1:])
    stepped = in_place.step(in_place.reset().set("action", chosen.clone()))
    assert torch.equal(stepped["action"], chosen)
    assert stepped["next", "cost_interventions"].flatten().tolist() == [1.0, 1.0]
    other = transform_env(PointMass(2), {"f": ActionFilter(half_speed)}, evaluating=False)
    wanted = other.step(other.reset().set("action", chosen.clone()))
    for key in ("observation", "reward"):
        assert torch.equal(stepped["next", key], wanted["next", key])


def test_a_filter_that_returns_no_actions_is_refused():
    broken = ActionFilter(lambda step: step["action"][:, :1])
    env = transform_env(PointMass(2), {"filter": broken}, evaluating=False)
    with pytest.raises(ValueError, match=re.escape("actions of shape (2, 2), got (2, 1)")):
        env.rollout(1)


def test_a_filter_gets_the_positions_before_the_step_and_the_layout_if_it_asks_for_them():
    seen = []

    def shield(step, positions, layout, part="robot"):
        seen.append((positions[part], step["observation"], layout))
        return step["action"]

    node = {"_target_": "safe_rl.envs.transforms.ActionFilter", "filter": partial(shield)}
    env = make_env("PointGoal1", num_envs=2, seed=0, transforms={"f": node, "s": RewardScale(0.5)})
    state = env.reset()
    for _ in range(3):
        # "robot" is the body's place, which the joints of a planar robot are
        xy = env.get_state()["qpos"][:, :2]
        state["action"] = torch.ones(2, 2)
        state = env.step(state)["next"].exclude("reward")
        torch.testing.assert_close(seen[-1][0][:, 0, :2], xy, rtol=0, atol=1e-9)
    assert seen[-1][2] == env.observation_layout
    assert not torch.equal(seen[0][0], seen[-1][0])
    blind = transform_env(PointMass(2), {"f": ActionFilter(shield)}, evaluating=False)
    with pytest.raises(ValueError, match="asks for 'positions'"):
        blind.rollout(1)


def test_interventions_can_have_a_budget():
    own = {"filter": ActionFilter(half_speed), "saute": Saute({"cost_interventions": 1.0}, **SAUTE)}
    env = transform_env(PointMass(1), own, evaluating=False)
    step = env.step(env.reset().set("action", torch.ones(1, 2)))
    assert step["next", "reward"].item() == -1
    with pytest.raises(ValueError, match=r"transforms.saute: .*Did you mean 'cost_north'"):
        transform_env(PointMass(1), {"saute": Saute({"cost_noth": 1.0}, **SAUTE)}, evaluating=False)


@pytest.mark.parametrize("env", ["point_mass", "safety_gym"])
def test_a_snapshot_goes_on_exactly(env):
    env = transformed(ENVIRONMENTS[env](), *TRANSFORMS.keys() - {"saute"})

    def go_on(state):
        torch.manual_seed(1)
        return env.rollout(
            15, auto_reset=False, tensordict=env.set_state(state), break_when_any_done=False
        )

    env.rollout(5)
    state = env.get_state()
    first, second = go_on(state.clone()), go_on(state.clone())
    assert (first["next", "observation"][..., -1] != 1).any()
    for key in ("observation", "reward", "terminated", "cost_interventions"):
        assert torch.equal(first["next", key], second["next", key])
    # a state that tells of worlds only: episodes' budgets begin anew
    begun = env.set_state(state.exclude("transforms"))
    assert begun["observation"].shape == first["observation"][:, 0].shape


def test_what_is_transformed_twice_goes_on_with_both():
    env = transformed(transformed(Priced([[0.5] * 9]), "saute"), "early_termination")
    last = still(env, 3)["next", "observation"][:, -1]
    begun = env.set_state(env.get_state())
    assert torch.equal(begun["observation"], last)
    # of a budget of 2.0 as much is left to spend
    steps = env.rollout(9, auto_reset=False, tensordict=begun)
    assert steps["next", "terminated"].squeeze().tolist() == [False, True]


def test_transforms_of_torchrl_can_stand_among_ours():
    counted = {"count": StepCounter(), "saute": TRANSFORMS["saute"]()}
    env = transform_env(PointMass(2), counted, evaluating=False)
    check_env_specs(env)
    # what they remember is in no snapshot
    assert env.get_state() is None


def test_without_the_contract_a_single_environment_is_transformed_too():
    env = TransformedEnv(SafetyGymEnv("PointGoal1", seed=0), Saute({"cost": 25.0}, **SAUTE))
    check_env_specs(env)


def test_without_the_contract_a_cost_that_there_is_not_is_named_all_the_same():
    env = TransformedEnv(SafetyGymEnv("PointGoal1", seed=0), EarlyTermination({"cost_hazard": 1.0}))
    with pytest.raises(ValueError, match=r"'cost_hazard'.*Did you mean 'cost_hazards'\?"):
        env.rollout(1)


def test_costs_may_be_nested():
    step = TensorDict({"agents": {"cost": torch.full((2, 1), 3.0)}}, [2])
    assert costs_of(step, [("agents", "cost")]).tolist() == [[3.0], [3.0]]
    with pytest.raises(ValueError, match=r"'agents/costs'.*Did you mean 'agents/cost'\?"):
        costs_of(step, [("agents", "costs")])


def test_nodes_are_built_and_their_keys_named():
    node = {
        "_target_": "safe_rl.envs.transforms.ActionFilter",
        "filter": {"_target_": "test_transforms.half_speed", "_partial_": True, "speed": 0.1},
    }
    env = make_env({"robot_base": "point"}, num_envs=2, seed=0, transforms={"slow": node})
    torch.manual_seed(0)
    assert env.rollout(4)["next", "cost_interventions"].all()
    wrong = {**node, "filter": {"_target_": "test_transforms.half_spe", "_partial_": True}}
    with pytest.raises(TargetError, match=r"transforms.slow: .*half_spe"):
        make_env({"robot_base": "point"}, transforms={"slow": wrong})
    loss = {"_target_": "safe_rl.objectives.LagrangeMultiplier", "init": 1.0, "lr": 0.1}
    loss["cost_limits"] = {"cost": 25.0}
    with pytest.raises(TargetError, match="no Transform"):
        make_env({"robot_base": "point"}, transforms={"slow": loss})


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Saute({}, **SAUTE), "budgets is empty"),
        (lambda: Saute({"cost": 0.0}, **SAUTE), "above 0"),
        (lambda: EarlyTermination({"cost": math.nan}), "at least 0"),
        (lambda: Saute({"cost": 1.0}, **SAUTE | {"discount": 0.0}), "discount=0"),
        (lambda: RewardScale(0.0), "factor=0"),
        (lambda: Simmer({"cost": 1.0}, first=0.0, steps=9, **SAUTE), "first=0"),
        (lambda: Simmer({"cost": 1.0}, first=0.5, steps=0, **SAUTE), "steps=0"),
        (lambda: transformed(PointMass(1), "saute", "simmer"), "one of saute and simmer"),
    ],
)
def test_what_cannot_be_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_one_of_ones_own_needs_a_step_only():
    class Tax(ConstraintTransform):
        """Every step costs reward."""

        def _step(self, tensordict, next_tensordict):
            return next_tensordict.set("reward", next_tensordict["reward"] - 1)

    env = transform_env(PointMass(1), {"tax": Tax()}, evaluating=False)
    action = TensorDict(action=torch.zeros(1, 2), batch_size=[1])
    assert env.step(env.reset().update(action))["next", "reward"].item() == -1
