"""Specs, names and sizes of both families' environments, ends of episodes, and partial resets."""

import itertools

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import SUITE, SafetyGymEnv, env_node, make_env
from safe_rl.envs.velocity import VELOCITY_SUITE

# By hand from sections 4, 8 and 9 of the benchmark's description: names and sizes.
COMMON_SENSORS = {"accelerometer": 3, "gyro": 3, "magnetometer": 3, "velocimeter": 3}
LEGS = [joint for leg in "1234" for joint in (f"hip_{leg}_y", f"hip_{leg}_z", f"ankle_{leg}")]
ROBOT_SENSORS = {
    "Point": COMMON_SENSORS,
    "Car": {**COMMON_SENSORS, "ballangvel_rear": 3, "ballquat_rear": 9},
    "Doggo": {
        **COMMON_SENSORS,
        **{f"jointpos_{joint}": 2 for joint in LEGS},
        **{f"jointvel_{joint}": 1 for joint in LEGS},
        **{f"touch_ankle_{leg}{end}": 1 for leg in (1, 2, 3, 4) for end in "ab"},
    },
}
LIDARS = {
    "Goal0": ["goal"],
    "Goal1": ["goal", "hazards", "vases"],
    "Goal2": ["goal", "hazards", "vases"],
    "Button0": ["buttons", "goal"],
    "Button1": ["buttons", "goal", "gremlins", "hazards"],
    "Button2": ["buttons", "goal", "gremlins", "hazards"],
    "Push0": ["box", "goal"],
    "Push1": ["box", "goal", "hazards", "pillars"],
    "Push2": ["box", "goal", "hazards", "pillars"],
}
ACTIONS = {"Point": 2, "Car": 2, "Doggo": 12}
COST_KINDS = {
    "Goal0": [],
    "Goal1": ["hazards"],
    "Goal2": ["hazards", "vases_contact", "vases_velocity"],
    "Button0": [],
    "Button1": ["buttons", "gremlins", "hazards"],
    "Button2": ["buttons", "gremlins", "hazards"],
    "Push0": [],
    "Push1": ["hazards"],
    "Push2": ["hazards", "pillars"],
}
NAMES = [(robot, task) for robot, task in itertools.product(ACTIONS, LIDARS)]


def test_the_suite_has_its_27_names():
    assert sorted(SUITE) == sorted(robot + task for robot, task in NAMES)


@pytest.mark.parametrize(("robot", "task"), NAMES)
def test_specs(robot, task):
    env = SafetyGymEnv(f"Safexp-{robot}{task}-v0", num_envs=2, seed=0, num_threads=1)
    observation = env.reset()["observation"]
    check_env_specs(env)
    sizes = ROBOT_SENSORS[robot] | {f"{kind}_lidar": 16 for kind in LIDARS[task]}
    columns, first = {}, 0
    for name in sorted(sizes):
        columns[name], first = slice(first, first + sizes[name]), first + sizes[name]
    assert env.observation_layout == columns
    assert env.observation_spec["observation"].shape == (2, first)
    assert env.max_episode_steps == 1000
    assert env.action_spec.shape == (2, ACTIONS[robot])
    low, high = env.action_spec.space.low, env.action_spec.space.high
    assert (low == -1).all()
    assert (high == 1).all()
    keys = ["reward", "cost", "cost_exception", *(f"cost_{kind}" for kind in COST_KINDS[task])]
    assert sorted(env.full_reward_spec.keys()) == sorted(keys)
    assert all(env.full_reward_spec[key].shape == (2, 1) for key in keys)
    nested = SafetyGymEnv(SUITE[robot + task].replace(observation_flatten=False), 2, seed=0)
    entries = nested.reset()["observation"]
    check_env_specs(nested)
    assert set(entries.keys()) == set(columns)
    for name, span in columns.items():
        assert torch.equal(entries[name].flatten(1), observation[:, span]), name


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_specs_of_the_velocity_family(name):
    env = make_env(name, num_envs=2, seed=0, num_threads=1)
    check_env_specs(env)
    assert env.cost_keys == ["cost", "cost_velocity"]
    assert list(env.full_reward_spec.keys()) == ["reward", *env.cost_keys]
    columns = [i for span in env.observation_layout.values() for i in range(span.start, span.stop)]
    assert columns == list(range(env.observation_spec["observation"].shape[-1]))


@pytest.mark.parametrize("env_name", ["PointGoal1", "SafeSwimmerVelocity"])
def test_rows_time_out_by_their_own_count(env_name):
    env = make_env({**env_node(env_name), "num_steps": 5}, num_envs=2, seed=0, num_threads=1)
    tensordict = env.reset()
    ends = []
    for step in range(12):
        following, tensordict = env.step_and_maybe_reset(env.rand_action(tensordict))
        ends.append(following["next", "truncated"][:, 0].tolist())
        if step == 1:
            mask = torch.tensor([[True], [False]])
            tensordict = env.reset(tensordict.set("_reset", mask))
    # Row 0 was started anew after two steps, so it times out two steps later ever after.
    assert [step for step, end in enumerate(ends) if end[0]] == [6, 11]
    assert [step for step, end in enumerate(ends) if end[1]] == [4, 9]


def test_a_reset_leaves_nothing_of_the_episode_before():
    env = SafetyGymEnv("CarButton2", num_envs=3, seed=0, num_threads=1)
    env.rollout(5)
    state = env.get_state()
    state["buttons_timer"][:] = 7
    env.set_state(state)
    env.reset()
    fresh = env.get_state()
    for key in ("buttons_timer", "step_count", "time", "qvel", "ctrl"):
        assert state[key].any(), key
        assert not fresh[key].any(), key


@pytest.mark.parametrize(
    ("env_name", "keys"),
    [("PointButton1", {}), ("SafeAntVelocity", {}), ("PointGoal1", {"observation_flatten": False})],
)
def test_nothing_that_is_returned_shares_memory(env_name, keys):
    """Also because TorchRL stacks the steps of a rollout at its end."""
    env = make_env({**env_node(env_name), **keys}, num_envs=3, seed=0, num_threads=1)
    first = env.reset()
    second = env.step(first.clone().set("action", env.action_spec.rand()))["next"]
    third = env.set_state(env.get_state())
    tensors = [value for result in (first, second, third) for value in result.values(True, True)]
    wanted = [value.clone() for value in tensors]
    env.rollout(3)
    assert all(map(torch.equal, tensors, wanted))
    for one, other in itertools.combinations(tensors, 2):
        before = other.clone()
        one.fill_(one.new_tensor(7).logical_not_() if one.dtype is torch.bool else 7)
        one.logical_not_()
        assert torch.equal(other, before)
