"""Somebody else's environments by a node: registered ones, and those of six values a step."""

import math
import sys
from functools import partial
from pathlib import Path

import gymnasium
import pytest
import torch
from gymnasium_envs import Walk  # registers Walk-v0
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import ConfigError, complete_env, from_gymnasium, make_env

NODE = {
    "_target_": "safe_rl.envs.gymnasium.make_gymnasium",
    "id": "Walk-v0",
    "cost_keys": ["fast", "far"],
}
ICE = {
    "_target_": "safe_rl.envs.gymnasium.make_safety_gymnasium",
    "id": "SafetyIce1-v0",
    "kwargs": {"border": 1.5},
}


@pytest.fixture
def package(monkeypatch):
    """The stand-in, as if it were installed."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "stand_in"))
    import safety_gymnasium

    yield safety_gymnasium
    del sys.modules["safety_gymnasium"]


PENDULUM = {"_target_": "safe_rl.envs.torchrl.make_torchrl", "id": "PendulumEnv"}
PENDULUM |= {"num_steps": 9, "outside": {"cost_speed": ["thdot", -4, 4]}}


@pytest.mark.parametrize("node", [NODE, PENDULUM], ids=["gymnasium", "torchrl"])
def test_seeds_determine_rows_and_share_none(node):
    starts = [
        make_env(node, num_envs=4, seed=seed).reset()["observation"][:, 0].tolist()
        for seed in (0, 0, 1, 2)
    ]
    assert starts[0] == starts[1]
    assert len({place for rows in starts for place in rows}) == 12


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (ICE | {"id": "SafetyIce2-v0"}, "SafetyIce2-v0 is not registered"),
        (ICE | {"id": "my_ice:SafetyMine-v0"}, "cannot import.*import=my_ice env.id=SafetyMine-v0"),
        (ICE | {"kwargs": {"speed": 3}}, "SafetyIce1-v0.*speed"),
        ({"id": None}, r"env\.id="),
        ({"id": "Wolk-v0"}, "Did you mean 'Walk-v0'.*import=my_module"),
        ({"id": "os.path:Walk-v0"}, "import=os.path env.id=Walk-v0"),
        ({"id": "GymV26Environment-v0", "kwargs": {"env_id": "os.path:W-v0"}}, "imports what its"),
        ({"border": 3}, "no key 'border'.*env.kwargs"),
        ({"num_steps": 0}, "num_steps=0: it must be greater"),
        ({"kwargs": {"speed": 3}}, "Walk-v0.*speed"),
        ({"cost_keys": "fast", "num_steps": 5}, "cost_keys=fast: it must be a valid tuple"),
        ({"cost_keys": []}, "what does a step cost"),
        ({"cost_keys": ["fast", "reward"]}, "'reward' is a state.*stays"),
        ({"outside": {"cost_x": [0, 1.0]}}, "got cost_x:"),
        ({"outside": {"cost_x": [0, 1.0, 0.0]}}, "cannot have the range 1.0 to 0.0"),
        ({"outside": {"far": [0, 0.0, 1.0]}}, "called cost or cost_<kind>, not 'far'"),
    ],
)
def test_what_cannot_be_made_is_said(keys, message, package):
    with pytest.raises(ConfigError, match=message):
        make_env({**NODE, **keys})


def test_observations_may_be_nested():
    nested = {**NODE, "kwargs": {"nested": True}}
    env = make_env(nested, num_envs=2, seed=0)
    flat = make_env({**nested, "flatten": True}, num_envs=2, seed=0).reset()["observation"]
    entries = env.reset()["observation"]
    torch.testing.assert_close(torch.cat([entries["place"], entries["side"]], -1), flat)
    assert env.observation_layout == {"place": slice(0, 2), "side": slice(2, 4)}
    check_env_specs(env)


def test_pictures_are_the_environments_own():
    node = complete_env(NODE)
    with pytest.raises(ValueError, match="render_mode=rgb_array"):
        make_env(node, seed=0).render(rows=0)
    env = make_env({**node, "render_mode": "rgb_array"}, num_envs=2, seed=0)
    place = env.reset()["observation"][1, 0].item()
    picture = env.render(rows=1)
    assert picture.shape == (20, 60, 3)
    assert picture.max(axis=(0, 2)).nonzero()[0].tolist() == [int(30 + 9 * place)]
    assert env.render().shape == (2, 20, 60, 3)
    assert env.render(rows=torch.tensor(1)).shape == (20, 60, 3)
    assert env.render(rows=torch.tensor([1])).shape == (1, 20, 60, 3)


def test_registered_arguments_and_limits_are_kept():
    made = []
    walk = lambda **keys: made.append(keys) or Walk(**keys)  # noqa: E731
    gymnasium.register("ShortWalk-v0", walk, max_episode_steps=3, kwargs={"border": 99.0})
    env = make_env({**NODE, "id": "ShortWalk-v0"}, num_envs=2, seed=0)
    assert len(made) == 1 + 2  # one more, for what the node does not say
    rollout = env.rollout(10)
    assert rollout.shape == (2, 3)
    assert rollout["next", "truncated"][:, -1].all()
    assert make_env({**NODE, "num_steps": 2}, seed=0).rollout(10).shape == (1, 2)


@pytest.mark.parametrize(
    ("outside", "reported", "bounds"),
    [
        ({"cost_a": [1, -0.3, 0.3]}, None, [1.0, 1.0]),
        ({"cost_a": [0, -0.04, 0.03], "cost_b": [2, -0.1, math.inf]}, None, [2.0, 1.0, 1.0]),
        ({"cost_a": [1, -0.3, 0.3]}, ["cost_told"], None),
    ],
)
def test_costs_of_ranges_are_bounded_in_the_spec_and_stand_beside_others(outside, reported, bounds):
    node = {**NODE, "id": "CartPole-v1", "num_steps": 200, "outside": outside}
    env = make_env(node | {"cost_keys": reported}, num_envs=3, seed=0)
    rollout = env.rollout(200, break_when_any_done=False)
    assert rollout["action"].dtype == torch.int64
    step = rollout["next"]
    for key, (column, low, high) in outside.items():
        place = step["observation"][..., [column]]
        expected = ((place < low) | (place > high)).float()
        assert 0 < expected.mean() < 1
        torch.testing.assert_close(step[key], expected)
    torch.testing.assert_close(step["cost"], sum(step[key] for key in outside))
    assert env.cost_keys == ["cost", *(reported or []), *outside]
    if bounds:
        assert [env.full_reward_spec[k].high.max().item() for k in env.cost_keys] == bounds
        check_env_specs(env)


def rollout(env):
    """Random actions, also beyond the bounds; their draws do not depend on the type of the spec."""
    torch.manual_seed(0)

    def act(tensordict):
        return tensordict.set("action", 2.2 * torch.rand(env.action_spec.shape) - 1.1)

    return env.rollout(40, act, break_when_any_done=False)


def test_a_step_has_its_cost_beside_the_reward(package):
    env = make_env(ICE, num_envs=5, seed=0)
    assert env.cost_keys == ["cost", "cost_right", "cost_fast"]
    assert env.max_episode_steps == 12
    check_env_specs(env)
    taken = rollout(env)
    place, speed = taken["next", "observation"].split(1, -1)
    torch.testing.assert_close(taken["next", "reward"], speed)
    torch.testing.assert_close(speed, 3 * taken["action"].clamp(-1, 1) + 1)  # from -2 to 4
    torch.testing.assert_close(taken["next", "cost_right"], (place > 0).float())
    torch.testing.assert_close(taken["next", "cost_fast"], speed.abs())
    torch.testing.assert_close(taken["next", "cost"], (place > 0) + speed.abs())
    torch.testing.assert_close(taken["next", "terminated"], place.abs() > 1.5)
    assert 0 < taken["next", "terminated"].sum() < 200


def test_a_task_ends_its_episodes_after_the_steps_that_are_asked_for(package):
    node = {**ICE, "id": "SafetyBuilt-v0", "kwargs": None}
    for keys, steps in (({}, 12), ({"num_steps": 20}, 20), ({"num_steps": 5}, 5)):
        env = make_env({**node, **keys}, num_envs=2, seed=0)
        assert env.max_episode_steps == steps
        assert rollout(env)["next", "truncated"][0, :, 0].nonzero()[0].item() == steps - 1


def test_a_step_whose_physics_failed_costs_what_it_returns(package):
    env = make_env({**ICE, "id": "SafetyBuilt-v0", "kwargs": None}, num_envs=2, seed=0)
    step = rollout(env)["next"]
    assert step["cost"][:, 2].tolist() == [[1.0], [1.0]]
    assert not step["cost_fast"][:, 2].any()


class OfAnotherOrder(gymnasium.Wrapper):
    """The cost, a whole number, comes after the ends."""

    def __init__(self, make):
        super().__init__(make())

    def step(self, action):
        observation, reward, cost, terminated, truncated, info = self.env.step(action)
        return observation, reward, bool(terminated), bool(truncated), int(cost), info


def test_a_function_may_return_six_values_and_a_missing_package_is_said(monkeypatch, package):
    ice = partial(package.make, "SafetyIce1-v0")
    env = from_gymnasium(ice, num_envs=5, num_steps=12, seed=0)
    assert env.cost_keys == ["cost", "cost_right", "cost_fast"]
    step = rollout(env)["next"]
    torch.testing.assert_close(step["cost"], step["cost_right"] + step["cost_fast"])
    swapped = partial(OfAnotherOrder, ice)
    with pytest.raises(
        ConfigError, match=r"fifth value of a step \(observation, reward, cost, ter"
    ):
        rollout(from_gymnasium(swapped, cost_keys=["cost"], num_steps=12, seed=0))
    with pytest.raises(ConfigError, match="third of six values: name 'cost' in cost_keys"):
        rollout(from_gymnasium(ice, cost_keys=["cost_fast"], num_steps=12, seed=0))
    monkeypatch.setitem(sys.modules, "safety_gymnasium", None)
    with pytest.raises(ConfigError, match=r"cannot be imported.*from_gymnasium"):
        make_env(ICE)
    monkeypatch.undo()
