"""Environments that are not ours, with costs in `info`, in TorchRL and under our algorithms."""

import copy
import functools
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, Sequence, Text
from gymnasium_envs import Walk, make_pendulum
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import ConfigError, from_gymnasium


class Counter(gymnasium.Env):
    """Terminates after as many steps as its seed says; observes what it was and how far it is."""

    observation_space = Dict(count=Discrete(5), length=Box(0, 9, (1,), np.float64))
    action_space = Box(0.0, 10.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.length = self.length if seed is None else seed
        self.count = 0
        return self.observe(), {}

    def observe(self):
        return {"count": self.count, "length": np.array([float(self.length)])}

    def step(self, action):
        self.count += 1
        info = {"cost": float(action[0]), "cost_late": float(self.count > 1)}
        return self.observe(), 1.0, self.count >= self.length, False, info


def acting(space):
    return type("Acting", (Counter,), {"action_space": space})


def observing(**entries):
    return type("Observing", (Counter,), {"observation_space": Dict(entries)})


def informing(told):
    """Environments like it whose info is `told(env)`."""
    step = lambda env, action: (*Counter.step(env, action)[:4], told(env))  # noqa: E731
    return type("Informing", (Counter,), {"step": step})


def test_costs_stand_beside_the_reward_and_are_those_of_the_environment():
    env = from_gymnasium(make_pendulum, num_envs=3, seed=0)
    assert env.cost_keys == ["cost", "cost_speed", "cost_upright"]
    assert sorted(env.reward_keys) == [*env.cost_keys, "reward"]
    step = env.rollout(20)["next"]
    x, _, speed = step["observation"].split(1, -1)
    torch.testing.assert_close(step["cost_speed"], (speed.abs() > 1).float())
    torch.testing.assert_close(step["cost_upright"], x.clamp(min=0))
    torch.testing.assert_close(step["cost"], step["cost_speed"] + step["cost_upright"])
    assert 0 < step["cost_speed"].sum() < 60
    check_env_specs(env)


def test_a_cost_that_no_info_has_is_told_after_an_episode():
    keys = ["cost_upright", "cost_power"]
    env = from_gymnasium(make_pendulum, num_envs=2, num_steps=5, cost_keys=keys, seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.rollout(4)
    told = r"'cost_power' is in no info of the first 5 steps.*infos have cost_speed, torque"
    with pytest.warns(UserWarning, match=told) as caught:
        step = env.rollout(20, break_when_any_done=False)["next"]
    assert len(caught) == 1
    assert step["cost_power"].eq(0).all()
    assert step["cost_upright"].gt(0).any()


WRONG_STEPS = {
    "shape": ({0: {"count": 1, "length": np.zeros(2)}}, r"\['length'\] must be in Box"),
    "text": ({0: {"count": 1, "length": "far"}}, r"\['length'\] must be in Box.*'far'"),
    "rewards": ({1: np.ones(3)}, r"the reward must be one number, but step 1 .*ndarray"),
    "cost": ({4: {"cost": "hot"}}, r"info\['cost'\] must be one number"),
    "choice": ({0: {"count": -1, "length": np.zeros(1)}}, r"\['count'\] must be in Discrete\(5\)"),
    "half": ({0: {"count": 0.5, "length": np.zeros(1)}}, r"\['count'\] must be in Discrete\(5\)"),
    "huge": ({1: 10**400}, "the reward must be one number"),
    "ends": ({2: np.zeros(3, bool)}, "terminated must be True or False, .*ndarray"),
    "word": ({3: "no"}, "truncated must be True or False, but step 1 returned a str, 'no'"),
    "no info": ({4: None}, "info must be a dictionary, but step 1"),
}


@pytest.mark.parametrize(("changes", "message"), WRONG_STEPS.values(), ids=WRONG_STEPS)
def test_what_a_step_must_not_return_is_told_with_entry_shape_and_step(changes, message):
    class Wrong(Counter):
        def step(self, action):
            return tuple(changes.get(i, part) for i, part in enumerate(super().step(action)))

    env = from_gymnasium(Wrong, num_envs=2, num_steps=4, cost_keys=["cost"], seed=3)
    with pytest.raises(ConfigError, match=message):
        env.rollout(2)


def test_another_number_of_values_is_told():
    kind = type("Wrong", (Walk,), {"step": lambda env, action: (1, 2)})
    with pytest.raises(ConfigError, match="five values, or six with a cost, but step 1"):
        from_gymnasium(kind, cost_keys=["fast"], num_steps=3, seed=0).rollout(1)


def test_a_cost_that_comes_late_and_is_not_counted_is_told():
    always = {"cost": 0.0, "cost_late": 0.0, "cost_limit": 25.0, "cost_total": 3.0}
    late = informing(lambda env: always | ({"cost_b": 1.0} if env.count == 3 else {}))
    env = from_gymnasium(late, num_envs=1, num_steps=6, seed=5)
    assert env.cost_keys == ["cost", "cost_late"]
    with pytest.warns(UserWarning, match=r"info\['cost_limit'\] is not counted"):
        env.rollout(2)
    with pytest.warns(UserWarning, match=r"info\['cost_b'\] is not counted.*cost,cost_l"):
        env.rollout(4)


def test_a_picture_that_is_flattened_is_told():
    class Seen(Counter):
        observation_space = Box(0, 255, (4, 4, 3), np.uint8)

        def observe(self):
            return self.observation_space.high

    with pytest.warns(UserWarning, match=r"'observation' is a picture, \(4, 4, 3\)"):
        env = from_gymnasium(Seen, num_steps=3, seed=0)
    assert env.rollout(1)["next", "observation"].unique().tolist() == [255.0]


def test_observed_choices_that_begin_at_another_number_are_refused_unless_flattened():
    class FromOne(Counter):
        observation_space = Dict(n=Discrete(3, start=1))

        def observe(self):
            return {"n": 2 if self.count else 3}

    make = functools.partial(from_gymnasium, FromOne, num_envs=1, num_steps=3, seed=0)
    assert make().rollout(1)["observation"][0, 0].tolist() == [0.0, 0.0, 1.0]
    for keys in ({"flatten": False}, {"privileged": "n"}):
        with pytest.raises(ConfigError, match=r"start=1\) is observed: let it begin at 0, or set"):
            make(**keys)


def test_a_sum_of_costs_in_info_is_the_cost_and_no_kind_of_its_own():
    summed = informing(lambda env: {"cost_sum": 3, "cost_a": 1, "cost_b": 2})
    env = from_gymnasium(summed, num_steps=4, seed=3)
    assert env.cost_keys == ["cost", "cost_a", "cost_b"]
    assert env.rollout(1)["next", "cost"].item() == 3


def test_costs_of_rows_may_be_of_different_types():
    costs = (0, 0.5, np.True_, np.float32(0.25), True, np.int64(2))
    toll = informing(lambda env: {"cost": costs[env.length % 6]})
    env = from_gymnasium(toll, num_envs=6, num_steps=5, seed=6)
    cost = env.rollout(2)["next", "cost"]
    assert cost[:, 0, 0].tolist() == [0.0, 0.5, 1.0, 0.25, 1.0, 2.0]
    assert torch.equal(cost[:, 0], cost[:, 1])


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_a_reset_may_be_given_what_a_reset_returned(device):
    env = from_gymnasium(Counter, num_envs=2, num_steps=4, seed=2, device=device)
    env.reset(env.reset())
    assert env.rollout(9, break_when_any_done=False)["next", "done"].sum() == 7


def test_rows_are_reset_apart():
    env = from_gymnasium(Counter, num_envs=3, num_steps=4, seed=2)
    rollout = env.rollout(9, break_when_any_done=False)
    # Episodes of 2, 3 and 4 steps, the last of which ends by its own and by the limit.
    ends = [[1, 3, 5, 7], [2, 5, 8], [3, 7]]
    done = rollout["next", "done"].squeeze(-1)
    assert [row.nonzero().flatten().tolist() for row in done] == ends
    torch.testing.assert_close(rollout["next", "terminated"], rollout["next", "done"])
    assert rollout["next", "truncated"].squeeze(-1).sum(1).tolist() == [0, 0, 2]
    counts = rollout["next", "observation"][..., :5].argmax(-1)
    assert counts[1].tolist() == [1, 2, 3] * 3
    assert (rollout["next", "cost_late"].squeeze(-1) == (counts > 1)).all()


def test_any_observation_becomes_a_vector_and_actions_are_stretched():
    env = from_gymnasium(Counter, num_steps=9, seed=4)
    assert env.cost_keys == ["cost", "cost_late"]
    tensordict = env.reset()
    assert tensordict["observation"].tolist() == [[1, 0, 0, 0, 0, 4]]
    assert tensordict["observation"].dtype == torch.float32
    for action, cost in ((-1.0, 0.0), (0.5, 7.5), (3.0, 10.0)):
        tensordict["action"] = torch.tensor([[action]])
        tensordict = env.step(tensordict)
        assert tensordict["next", "cost"].item() == pytest.approx(cost)
        tensordict = env.step_mdp(tensordict)


def moving(tensordict):
    """Actions that are as different as what is seen."""
    action = torch.sin(40 * tensordict["observation"].sum(-1, keepdim=True))
    return tensordict.set("action", action)


def test_a_copy_continues_as_the_original_does():
    env = from_gymnasium(lambda: Walk(), num_envs=3, num_steps=7, cost_keys=["fast", "far"], seed=1)
    before = env.rollout(3, moving)[:, -1]["next"]
    resume = {"auto_reset": False, "break_when_any_done": False}
    expected, got = (
        one.rollout(20, moving, tensordict=before.clone(), **resume)
        for one in (env, copy.deepcopy(env))
    )
    assert expected["next", "done"].sum() > 3
    for key in ("observation", "reward", "cost", "done"):
        assert torch.equal(got["next", key], expected["next", key])


def test_a_new_environment_can_be_copied():
    env = from_gymnasium(lambda: Walk(), num_steps=7, cost_keys=["fast", "far"], seed=1)
    assert copy.deepcopy(env).rollout(2).shape == (1, 2)


@pytest.mark.parametrize(
    ("given", "arguments", "told"),
    [
        ("Pendulum-v1", {"cost_keys": None}, r"reports no costs.*name it in 'cost_keys'"),
        (acting(Box(-np.inf, np.inf, (1,))), {}, r"or choices \(Discrete.*, got Unbounded"),
        (acting(Box(0.0, np.inf, (2,))), {}, r"finite bounds.* \[0.0, 0.0\] and \[inf, inf\]"),
        (Counter(), {}, r"'env' must be an id or a function.* give its class, or a function"),
        (acting(Dict(a=Box(0.0, 1.0))), {}, "Actions have several parts, Dict"),
        (Counter, {"num_steps": None}, "give 'num_steps'"),
        (Counter, {"num_envs": 0}, "num_envs=0: it must be greater than or equal to 1"),
        (Counter, {"outside": {"cost_a": ["count", 0, 2]}}, "'count'.*need flatten=False"),
        # a step writes an entry of this name; it would be nested
        (observing(reward=Box(0, 1)), {"flatten": False}, "an entry 'reward': rename it"),
        (observing(**{"a.b": Box(0, 1)}), {"flatten": False}, "an entry 'a.b': rename it"),
        (observing(a=Sequence(Box(0, 1))), {}, "'a' is observed, a Sequence, and networks"),
        (observing(a=Text(4)), {"flatten": False}, "'a' is observed, a Text, and networks"),
    ],
)
def test_what_cannot_be_made_is_said(given, arguments, told):
    with pytest.raises(ValueError, match=told):
        from_gymnasium(given, **{"num_steps": 5, "cost_keys": ["cost"], **arguments})
