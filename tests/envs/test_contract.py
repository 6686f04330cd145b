"""Environments of every family fulfil the contract, and what lacks something is told what."""

import pytest
import torch
from gymnasium_envs import Walk
from point_mass import PointMass
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import PendulumEnv

from safe_rl.envs import (
    ConstrainedEnv,
    ContractError,
    check_constrained_env,
    from_gymnasium,
    make_env,
)
from safe_rl.targets import TargetError, allow

COSTS = ["fast", "far"]


def walk(num_envs=3, **kwargs):
    return from_gymnasium(Walk, num_envs=num_envs, cost_keys=COSTS, num_steps=25, **kwargs)


@pytest.mark.parametrize(
    ("make", "steps", "snapshots"),
    [
        (lambda: make_env("CarButton2", num_envs=2), 1000, True),
        (lambda: make_env({"num_steps": 7, "robot_base": "point"}), 7, True),
        (lambda: make_env("PointGoal1Vision"), 1000, True),
        (walk, 25, False),
        (lambda: PointMass(2, num_steps=20), 20, True),
    ],
    ids=["suite", "own keys", "nested", "gymnasium", "point mass"],
)
def test_every_family_fulfils_it(make, steps, snapshots):
    env = make()
    check_constrained_env(env)
    assert isinstance(env, ConstrainedEnv)
    assert env.max_episode_steps == steps
    assert (env.get_state() is not None) == snapshots


def without(name):
    env = PointMass(2)
    cls = type("Lacking", (PointMass,), {name: None})
    env.__class__ = cls
    env.__dict__.pop(name, None)
    return env


def with_unbounded_actions():
    env = PointMass(2)
    env.action_spec = Unbounded((2, 2))
    return env


def with_numbers(dtype):
    env = PointMass(2)
    shape = env.observation_spec["observation"].shape
    env.observation_spec = Composite(observation=Unbounded(shape, dtype=dtype), shape=(2,))
    return env


def with_layout(**layout):
    env = PointMass(2)
    env.observation_layout = layout
    return env


def without_truncations():
    env = PointMass(2)
    flag = Binary(1, shape=(2, 1), dtype=torch.bool)
    env.done_spec = Composite(done=flag, terminated=flag.clone(), shape=(2,))
    return env


def with_costs(keys):
    env = PointMass(2)
    env.cost_keys = keys
    return env


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: object(), "no environment of TorchRL"),
        (lambda: PendulumEnv(), r"batch size must be \[N\].*SerialEnv"),
        (lambda: without("max_episode_steps"), "'max_episode_steps' must be.*got None"),
        (lambda: without("cost_keys"), "'cost_keys' must be a list of names with 'cost'"),
        (lambda: without("observation_layout"), "'observation_layout' must map names"),
        (lambda: without("set_state"), "it has 'get_state', so it needs 'set_state'"),
        (lambda: with_numbers(torch.float64), "'observation' must be of float32.*float64"),
        (lambda: with_layout(place=slice(0, 99)), r"slice\(0, 99, None\) for 'place', beyond the"),
        (without_truncations, "its done spec must have 'truncated', got"),
        (with_unbounded_actions, "continuous and bounded, or choices, got Unbounded"),
        (
            lambda: with_costs(["cost", "cost_south"]),
            r"reward spec must have 'cost_south', got \['cost', 'cost_hazards', 'cost_north'",
        ),
    ],
)
def test_what_is_missing_is_named(make, message):
    with pytest.raises(ContractError, match=message):
        check_constrained_env(make())


def make_own(config, *, num_envs, device, seed, num_threads):
    """A family of one's own."""
    return PointMass(num_envs, seed=seed, **config)


def make_lacking(config, **kind):
    return with_costs(["cost_hazards"])


def test_a_family_of_ones_own_is_made_once_its_module_is_trusted():
    node = {"_target_": f"{__name__}.make_own", "name": "mine", "num_steps": 9}
    with pytest.raises(TargetError, match=rf"env\._target_={__name__}.*import={__name__}"):
        make_env(node, num_envs=3)
    allow(__name__)
    env = make_env(node, num_envs=3, seed=1)
    assert isinstance(env, PointMass)
    assert (env.max_episode_steps, env.batch_size[0]) == (9, 3)
    with pytest.raises(ContractError, match="'cost' among them"):
        make_env({"_target_": f"{__name__}.make_lacking"}, num_envs=2)


def make_one(config, **_):
    """A family that ignores how many it is asked for."""
    return PointMass(1)


def test_a_family_that_makes_another_number_is_told():
    allow(__name__)
    with pytest.raises(ContractError, match=r"asked for 3 environments and made 1.*'num_envs'"):
        make_env({"_target_": f"{__name__}.make_one"}, num_envs=3)
