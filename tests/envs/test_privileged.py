"""The entry `privileged`: what it says, that states have it, and where else it may come from."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium_envs import Walk
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import ConfigError, from_gymnasium, make_env

KEYS = {"observe_privileged": True, "constrain_vases": True, "constrain_indicator": False}


def make(name="PointGoal2", **changes):
    return make_env(name, num_envs=4, seed=0, num_threads=1, **{**KEYS, **changes})


def part(env, step, name):
    return step["privileged"][..., env.privileged_layout[name]]


def test_it_is_off_by_default_and_its_spec_is_true():
    plain = make_env("PointGoal2", num_envs=2, seed=0)
    assert not plain.privileged_layout
    assert "privileged" not in plain.reset()
    for name in ("PointGoal2", "CarButton2", "DoggoPush2"):
        check_env_specs(make(name, constrain_vases=name == "PointGoal2"))


def test_it_says_what_steps_cost_and_where_objects_are():
    env = make()
    torch.manual_seed(0)
    rollout = env.rollout(60)
    step = rollout["next"]
    costs = torch.cat([step[key] for key in env.cost_keys], -1)
    torch.testing.assert_close(part(env, step, "last_costs"), costs)
    trace = torch.zeros_like(costs[:, 0])
    for cost, got in zip(costs.unbind(1), part(env, step, "cost_traces").unbind(1), strict=True):
        trace = 0.95 * trace + 0.05 * cost
        torch.testing.assert_close(got, trace)
    assert part(env, rollout[:, 0], "last_costs").eq(0).all()
    # distances do not depend on the frame
    places = env.get_positions()
    got = part(env, step[:, -1], "hazards_position").unflatten(-1, (-1, 3)).norm(dim=-1)
    wanted = (places["hazards"] - places["robot"]).norm(dim=-1)
    torch.testing.assert_close(got, wanted.float())
    speed = part(env, step[:, -1], "vases_velocity").unflatten(-1, (-1, 3)).norm(dim=-1)
    torch.testing.assert_close(speed, env._world.velocities.norm(dim=-1).float())


def test_some_of_its_components_may_be_chosen():
    every, some = make(), make(observe_privileged=("cost_traces", "hazards_position"))
    check_env_specs(some)
    steps = []
    for env in (every, some):
        env.set_seed(0)
        torch.manual_seed(0)
        steps.append(env.rollout(20)["next"])
    assert list(some.privileged_layout) == ["cost_traces", "hazards_position"]
    for name in some.privileged_layout:
        assert torch.equal(part(every, steps[0], name), part(some, steps[1], name))
    with pytest.raises(
        ConfigError, match=r"no component 'cost_trace'\. Did you mean 'cost_traces'"
    ):
        make(observe_privileged=("cost_trace",))


def test_since_goal_counts_from_the_last_goal():
    env = make("PointGoal0", goal_size=1.5, constrain_vases=False)
    step = env.rollout(30)["next"]
    assert step["goal_met"].any()
    count = torch.zeros(4)
    since = part(env, step, "since_goal")[..., 0]
    for met, got in zip(step["goal_met"][..., 0].unbind(1), since.unbind(1), strict=True):
        count = torch.where(met, 0.0, count + 1)
        torch.testing.assert_close(got, count / 1000)


def test_a_state_has_what_it_remembers():
    env, other = make(), make()
    env.rollout(20)
    state = env.get_state()
    assert torch.equal(other.set_state(state)["privileged"], env.set_state(state)["privileged"])
    assert other.get_state()["cost_traces"].shape == (4, len(env.cost_keys))
    env.set_state(state.exclude("cost_traces"))  # as in a state from before


class Hidden(Walk):
    """Observes a place, and has a wind that critics may know."""

    observation_space = spaces.Dict(
        place=spaces.Box(-9, 9, (2,), np.float32), wind=spaces.Box(-1, 1, (3,), np.float32)
    )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return {"place": np.zeros(2, np.float32), "wind": np.ones(3, np.float32)}, {}

    def step(self, action):
        observation, _ = self.reset()
        return observation, 0.0, False, False, {"cost": 1.0}


def test_an_entry_of_a_dictionary_becomes_privileged():
    env = from_gymnasium(Hidden, num_envs=2, num_steps=4, cost_keys=["cost"], privileged="wind")
    step = env.rollout(2)["next"]
    assert step["privileged"].tolist() == [[[1.0] * 3] * 2] * 2
    assert step["observation"].shape == (2, 2, 2)
    assert env.privileged_layout == {"wind": slice(0, 3)}
    check_env_specs(env)
    with pytest.raises(ConfigError, match=r"env.privileged: there is no entry 'wnd'.*'wind'"):
        from_gymnasium(Hidden, num_steps=4, cost_keys=["cost"], privileged="wnd")


def test_an_entry_of_torchrl_becomes_privileged():
    keys = {"num_steps": 5, "outside": {"cost_angle": ["th", -1, 1]}, "observe": ["th"]}
    env = make_env("torchrl", num_envs=2, id="PendulumEnv", privileged="thdot", **keys)
    assert env.rollout(3)["next", "privileged"].shape == (2, 3, 1)
