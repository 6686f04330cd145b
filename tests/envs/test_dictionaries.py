"""Dictionaries of the 2019 engine, as they are."""

import math

import numpy as np
import pytest

from safe_rl.envs import ConfigError, SafetyGymConfig, SafetyGymEnv


def test_a_file_of_ones_own_is_not_taken_for_the_bundled_one(tmp_path, monkeypatch):
    (tmp_path / "xmls").mkdir()
    (tmp_path / "xmls" / "car.xml").write_text("<mujoco/>")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"xmls/car\.xml has no body"):
        SafetyGymEnv({"robot_base": "xmls/car.xml"})


def test_more_locations_than_objects_are_told_and_ignored():
    keys = {"robot_base": "point", "hazards_num": 1, "hazards_locations": [[1, 0], [0, 1]]}
    with pytest.warns(UserWarning, match="'hazards_locations' has 2 locations for 1 objects"):
        env = SafetyGymEnv(keys, num_threads=1)
    env.reset()
    assert env.get_positions()["hazards"][0, :, :2].tolist() == [pytest.approx([1, 0], abs=1e-6)]


def test_values_of_numpy_are_those_of_python():
    given = {
        **{"hazards_num": np.int64(3), "num_steps": np.float32(7.0), "task": np.str_("push")},
        **{"constrain_hazards": np.True_, "goal_size": np.float64(0.5)},
        **{"placements_extents": np.array([-3, -3, 3, 3]), "sensors_obs": np.array(["gyro"])},
    }
    plain = {key: value.tolist() for key, value in given.items()}
    config = SafetyGymConfig(**given)
    assert config == SafetyGymConfig(**plain)
    assert {type(config.hazards_num), type(config.num_steps)} == {int}
    assert config.constrain_hazards is True
    for wrong in ({"hazards_num": np.True_}, {"lidar_alias": np.int8(1)}):
        with pytest.raises(ConfigError):
            SafetyGymConfig(**wrong)


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
    # to the left and behind, at 126.9 degrees: in the fourth bin of 36 degrees
    assert seen[layout["goal_lidar"]].tolist() == pytest.approx([0, 0, 0, near] + [0] * 6)
