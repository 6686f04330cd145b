"""Environments whose step returns six values: by id, and from a function."""

import sys
from functools import partial
from pathlib import Path

import gymnasium
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import ConfigError, from_gymnasium, make_env

NODE = {
    "_target_": "safe_rl.envs.gymnasium.make_safety_gymnasium",
    "id": "SafetyIce1-v0",
    "kwargs": {"border": 1.5},
}


@pytest.fixture(autouse=True)
def package(monkeypatch):
    """The stand-in, as if it were installed."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "stand_in"))
    import safety_gymnasium

    yield safety_gymnasium
    del sys.modules["safety_gymnasium"]


def rollout(env):
    """Random actions, also beyond the bounds; their draws do not depend on the type of the spec."""
    torch.manual_seed(0)

    def act(tensordict):
        return tensordict.set("action", 2.2 * torch.rand(env.action_spec.shape) - 1.1)

    return env.rollout(40, act, break_when_any_done=False)


def test_a_step_has_its_cost_beside_the_reward():
    env = make_env(NODE, num_envs=5, seed=0)
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


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"id": "SafetyIce2-v0"}, "SafetyIce2-v0 is not registered"),
        ({"id": "my_ice:SafetyMine-v0"}, r"cannot import.*import=my_ice env.id=SafetyMine-v0"),
        ({"kwargs": {"speed": 3}}, "SafetyIce1-v0.*speed"),
    ],
)
def test_what_cannot_be_made_is_said(keys, message):
    with pytest.raises(ConfigError, match=message):
        make_env({**NODE, **keys})


def test_a_task_ends_its_episodes_after_the_steps_that_are_asked_for():
    node = {**NODE, "id": "SafetyBuilt-v0", "kwargs": None}
    for keys, steps in (({}, 12), ({"num_steps": 20}, 20), ({"num_steps": 5}, 5)):
        env = make_env({**node, **keys}, num_envs=2, seed=0)
        assert env.max_episode_steps == steps
        assert rollout(env)["next", "truncated"][0, :, 0].nonzero()[0].item() == steps - 1


def test_a_step_whose_physics_failed_costs_what_it_returns():
    env = make_env({**NODE, "id": "SafetyBuilt-v0", "kwargs": None}, num_envs=2, seed=0)
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
        make_env(NODE)
    monkeypatch.undo()
