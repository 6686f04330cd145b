"""Specs, names and sizes of both families' environments, ends of episodes, and partial resets."""

import itertools

import gymnasium
import pytest
import torch
from torchrl.envs import ConditionalSkip, TransformedEnv
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import SafetyGymEnv, env_node, from_gymnasium, make_env, resolve
from safe_rl.envs.transforms import ObservedCosts, Saute
from safe_rl.envs.velocity import VELOCITY_SUITE

SAUTE = Saute({"cost": 5.0}, discount=0.9, unsafe_reward=0.0, rescale_budgets=True)
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
ACTIONS = {"Point": 2, "Car": 2, "Doggo": 12}
# Its suite in the style of 2019.
ROBOTS = {
    "Point": {"robot_base": "xmls/point.xml"},
    "Car": {
        **{"robot_base": "xmls/car.xml", "box_size": 0.125, "box_keepout": 0.125},
        "box_density": 0.0005,
    },
    "Doggo": {
        "robot_base": "xmls/doggo.xml",
        "sensors_obs": [
            *("accelerometer", "velocimeter", "gyro", "magnetometer"),
            *(f"touch_ankle_{leg}{end}" for end in "ab" for leg in (1, 2, 3, 4)),
        ],
    },
}
EVERYWHERE = {
    **{"observe_goal_lidar": True, "observe_box_lidar": True},
    **{"lidar_max_dist": 3, "lidar_num_bins": 16},
}
TASKS = {
    "Goal": {
        **{"task": "goal", "goal_size": 0.3, "goal_keepout": 0.305},
        **{"hazards_size": 0.2, "hazards_keepout": 0.18},
    },
    "Button": {
        **{"task": "button", "buttons_num": 4, "buttons_size": 0.1, "buttons_keepout": 0.2},
        **{"observe_buttons": True, "hazards_size": 0.2, "hazards_keepout": 0.18},
        **{"gremlins_travel": 0.35, "gremlins_keepout": 0.4},
    },
    "Push": {"task": "push", "box_size": 0.2, "box_null_dist": 0, "hazards_size": 0.3},
}
COST_KINDS = {"vases": ("vases_contact", "vases_velocity")}
# Half of the extents, what is observed, what costs, and how many there are.
BUTTON_COSTS = ("hazards", "buttons", "gremlins")
LEVELS = {
    "Goal0": (1, (), (), {}),
    "Goal1": (1.5, ("hazards", "vases"), ("hazards",), {"hazards": 8, "vases": 1}),
    "Goal2": (2, ("hazards", "vases"), ("hazards", "vases"), {"hazards": 10, "vases": 10}),
    "Button0": (1, (), (), {}),
    "Button1": (1.5, ("hazards", "gremlins"), BUTTON_COSTS, {"hazards": 4, "gremlins": 4}),
    "Button2": (1.8, ("hazards", "gremlins"), BUTTON_COSTS, {"hazards": 8, "gremlins": 6}),
    "Push0": (1, (), (), {}),
    "Push1": (1.5, ("hazards", "pillars"), ("hazards",), {"hazards": 2, "pillars": 1}),
    "Push2": (2, ("hazards", "pillars"), ("hazards", "pillars"), {"hazards": 4, "pillars": 4}),
}


def dictionary(robot: str, level: str) -> dict:
    half, observed, constrained, numbers = LEVELS[level]
    return {
        **{**EVERYWHERE, **TASKS[level[:-1]], **ROBOTS[robot]},
        "placements_extents": [-half, -half, half, half],
        **{f"observe_{kind}": True for kind in observed},
        **{f"constrain_{kind}": True for kind in constrained},
        **{f"{kind}_num": number for kind, number in numbers.items()},
    }


NAMES = list(itertools.product(ROBOTS, LEVELS))


@pytest.mark.parametrize(("robot", "level"), NAMES)
def test_names_of_the_suite_make_its_dictionaries_and_specs(robot, level):
    config = resolve(robot + level)
    assert resolve(dictionary(robot, level)) == config
    env = SafetyGymEnv(f"Safexp-{robot}{level}-v0", num_envs=2, seed=0, num_threads=1)
    observation = env.reset()["observation"]
    check_env_specs(env)
    _, observed, constrained, _ = LEVELS[level]
    seen = ["goal", *observed, *{"Button": ["buttons"], "Push": ["box"]}.get(level[:-1], [])]
    sizes = ROBOT_SENSORS[robot] | {f"{kind}_lidar": 16 for kind in seen}
    columns, first = {}, 0
    for name in sorted(sizes):
        columns[name], first = slice(first, first + sizes[name]), first + sizes[name]
    assert env.observation_layout == columns
    assert env.observation_spec["observation"].shape == (2, first)
    assert env.max_episode_steps == 1000
    assert env.action_spec.shape == (2, ACTIONS[robot])
    assert (env.action_spec.space.low == -1).all()
    assert (env.action_spec.space.high == 1).all()
    kinds = [k for kind in constrained for k in COST_KINDS.get(kind, (kind,))]
    keys = ["reward", "cost", "cost_exception", *(f"cost_{kind}" for kind in kinds)]
    assert sorted(env.full_reward_spec.keys()) == sorted(keys)
    assert all(env.full_reward_spec[key].shape == (2, 1) for key in keys)
    nested = SafetyGymEnv(config.replace(observation_flatten=False), 2, seed=0)
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


@pytest.mark.parametrize("env_name", ["PointGoal1", "SafeHopperVelocity", "Pendulum-v1"])
def test_specs_hold_with_another_default_dtype(env_name):
    torch.set_default_dtype(torch.float64)
    try:
        if env_name in gymnasium.registry:
            env = from_gymnasium(env_name, num_envs=2, outside={"cost_speed": [2, -1, 1]})
        else:
            env = make_env(env_name, num_envs=2, transforms={"costs": ObservedCosts(0.9)})
        check_env_specs(env)
        if env_name == "PointGoal1":
            check_env_specs(make_env(env_name, observation_flatten=False, transforms={"s": SAUTE}))
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("name", ["PointGoal1", "SafeSwimmerVelocity"])
def test_a_rollout_until_all_rows_have_ended_repeats_their_last_steps(name):
    env = make_env({**env_node(name), "num_steps": 5}, num_envs=2, seed=0, num_threads=1)
    state = env.rollout(2)[:, -1]["next"].select("observation", "done", "terminated", "truncated")
    state = env.reset(state.set("_reset", torch.tensor([[True], [False]])))
    ends = {"break_when_any_done": False, "break_when_all_done": True}
    steps = env.rollout(9, auto_reset=False, tensordict=state, **ends)
    assert steps.shape == (2, 5)  # row 0 began anew, row 1 has three steps left
    for flag in ("done", "truncated"):
        assert steps["next", flag].squeeze(-1).sum(1).tolist() == [1, 3]
    for entry in ("observation", "reward", "cost"):
        last = steps["next", entry][1, 2]
        assert (steps["next", entry][1, 2:] == last).all()
    # after a reset every step of every row counts
    with pytest.raises(NotImplementedError, match="step of some worlds only"):
        env.step(env.rand_action(env.reset()).set("_step", torch.tensor([True, False])))


@pytest.mark.parametrize("name", ["PointGoal1", "SafeHopperVelocity"])
def test_steps_of_some_rows_only_are_refused(name):
    skip = ConditionalSkip(lambda step: torch.tensor([True, False]))
    env = TransformedEnv(make_env(name, num_envs=2, seed=0), skip)
    with pytest.raises(NotImplementedError, match=r"step of some worlds only.*num_envs=1"):
        env.rollout(2)
    alone = ConditionalSkip(lambda step: torch.tensor([True]))
    assert TransformedEnv(make_env(name, num_envs=1, seed=0), alone).rollout(2).shape == (1, 2)


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
