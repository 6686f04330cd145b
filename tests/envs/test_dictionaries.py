"""Dictionaries of the 2019 engine, as they are."""

import math

import numpy as np
import pytest

from safe_rl.envs import SUITE, ConfigError, SafetyGymConfig, SafetyGymEnv, resolve

# By hand from section 9 of the benchmark's description, in the style of its suite.
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
            *("touch_ankle_1a", "touch_ankle_2a", "touch_ankle_3a", "touch_ankle_4a"),
            *("touch_ankle_1b", "touch_ankle_2b", "touch_ankle_3b", "touch_ankle_4b"),
        ],
    },
}
EVERYWHERE = {
    **{"observe_goal_lidar": True, "observe_box_lidar": True},
    **{"lidar_max_dist": 3, "lidar_num_bins": 16, "_seed": None, "build_resample": True},
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


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_dictionaries_of_the_suite_are_its_environments(robot, level):
    assert resolve(dictionary(robot, level)) == SUITE[robot + level]


def test_a_file_of_ones_own_is_not_taken_for_the_bundled_one(tmp_path, monkeypatch):
    (tmp_path / "xmls").mkdir()
    (tmp_path / "xmls" / "car.xml").write_text("<mujoco/>")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"xmls/car\.xml has no body"):
        SafetyGymEnv({"robot_base": "xmls/car.xml"})


def test_values_of_numpy_are_those_of_python():
    given = {
        **{"hazards_num": np.int64(3), "num_steps": np.float32(7.0), "task": np.str_("push")},
        **{"constrain_hazards": np.True_, "goal_size": np.float64(0.5)},
        **{"placements_extents": np.array([-3, -3, 3, 3]), "sensors_obs": np.array(["gyro"])},
    }
    plain = {key: value.tolist() for key, value in given.items()}
    config = SafetyGymConfig.from_dict(given)
    assert config == SafetyGymConfig.from_dict(plain)
    assert {type(config.hazards_num), type(config.num_steps)} == {int}
    assert config.constrain_hazards is True
    for wrong in ({"hazards_num": np.True_}, {"lidar_alias": np.int8(1)}):
        with pytest.raises(ConfigError):
            SafetyGymConfig.from_dict(wrong)


@pytest.mark.parametrize("clip", [0, None, 0.5])
def test_a_clip_of_0_is_none(clip):
    keys = {"robot_base": "point", "reward_distance": 1e4, "reward_clip": clip}
    env = SafetyGymEnv(keys, num_envs=3, seed=0, num_threads=1)
    env.reset()
    reward = env.rand_step(env.reset())["next", "reward"].abs()
    assert (reward == 0.5).all() if clip else (reward > 0.5).all()


@pytest.mark.parametrize("task", ["circle", "none"])
def test_the_goal_of_tasks_without_one_is_the_origin(task):
    keys = {"robot_base": "point", "task": task, "robot_rot": 0.0, "robot_locations": [[0.3, -0.4]]}
    keys |= {"observe_goal_lidar": True, "observe_goal_comp": True, "observe_goal_dist": True}
    env = SafetyGymEnv({**keys, "lidar_alias": False}, num_envs=1, seed=0, num_threads=1)
    seen, layout = env.reset()["observation"][0], env.observation_layout
    assert "goal" not in env.object_names
    near = math.exp(-0.5)
    assert seen[layout["goal_dist"]].item() == pytest.approx(near)
    assert seen[layout["goal_compass"]].tolist() == pytest.approx([-0.6, 0.8], abs=2e-3)
    # to the left and back: 126.9 degrees of 36 each
    assert seen[layout["goal_lidar"]].tolist() == pytest.approx([0, 0, 0, near] + [0] * 6)
