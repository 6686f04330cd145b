"""The parts of the reference that no recorded case reaches, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from . import ReferenceWorld, by_kind

# A robot that stands in the origin and looks along x.
AT_REST = {"qpos": np.zeros(3), "qvel": np.zeros(3)}
POINT = {"robot_base": "point", "task": "none", "sensors_obs": []}


def at_rest(config: dict, layout: dict, **state) -> ReferenceWorld:
    world = ReferenceWorld({**POINT, **config})
    world.set_state(**AT_REST, layout=layout, **state)
    return world


def with_vase(config: dict, start: tuple, now: tuple, speed: float = 0.0) -> ReferenceWorld:
    """A world whose only vase stood at `start`, stands at `now` and moves along x."""
    world = ReferenceWorld({**POINT, "vases_num": 1, "constrain_vases": True, **config})
    vase = [*now, 0.1 - 4e-5, 1, 0, 0, 0]
    qvel = [0, 0, 0, speed, 0, 0, 0, 0, 0]
    world.set_state([0, 0, 0, *vase], qvel, layout={"vases": [start]})
    return world


def test_unknown_key_names_the_nearest():
    with pytest.raises(ValueError, match="hazards_size"):
        ReferenceWorld({"hazard_size": 0.2})


def test_layout_by_name_and_by_kind_agree():
    named = by_kind({"vase1": [3, 4], "vase0": [1, 2], "goal": [5, 6]})
    kinds = by_kind({"vases": [[1, 2], [3, 4]], "goal": [[5, 6]]})
    assert named.keys() == kinds.keys()
    assert all(np.array_equal(named[kind], kinds[kind]) for kind in named)


def test_lidar_without_alias_reads_one_bin_with_exponential_gain():
    config = {"hazards_num": 1, "observe_hazards": True, "lidar_num_bins": 8}
    config |= {"lidar_alias": False, "lidar_exp_gain": 0.5}
    bearing, distance = np.deg2rad(100), 1.7
    place = [distance * np.cos(bearing), distance * np.sin(bearing)]
    expected = np.zeros(8)
    expected[2] = np.exp(-0.5 * distance)
    np.testing.assert_allclose(at_rest(config, {"hazards": [place]}).observe(), expected)


def test_lidar_alias_shares_a_reading_with_both_neighbours():
    config = {"hazards_num": 1, "observe_hazards": True, "lidar_num_bins": 4, "lidar_max_dist": 2}
    bearing = 2 * np.pi / 4 * 0.25
    place = [np.cos(bearing), np.sin(bearing)]
    reading = at_rest(config, {"hazards": [place]}).observe()
    np.testing.assert_allclose(reading, [0.5, 0.25 * 0.5, 0, 0.75 * 0.5])


def test_bearing_a_rounding_error_below_the_x_axis_is_in_the_last_bin():
    config = {"hazards_num": 1, "observe_hazards": True, "lidar_num_bins": 4}
    reading = at_rest(config, {"hazards": [[1.0, -1e-20]]}).observe()
    np.testing.assert_allclose(reading[[0, 3]], np.exp(-1.0))


@pytest.mark.parametrize("components", [2, 3])
def test_compass(components):
    config = {"task": "goal", "observe_goal_comp": True, "compass_shape": components}
    compass = at_rest(config, {"goal": [[3.0, 4.0]]}).observe()
    # The goal's centre is 0.16 m high, the robot's 0.1 m.
    ego = np.array([3.0, 4.0, 0.06])[:components]
    np.testing.assert_allclose(compass, ego / (np.linalg.norm(ego) + 0.001))


def test_displaced_vase_costs_its_distance_in_the_plane():
    config = {"constrain_indicator": False, "vases_displace_cost": 2.0}
    world = with_vase(config, start=(1.0, 0.0), now=(1.3, 0.4))
    np.testing.assert_allclose(world.step([0, 0])["cost_vases_displace"], 1.0, atol=1e-5)
    world = with_vase(config, start=(1.0, 0.0), now=(1.0005, 0.0))
    assert world.step([0, 0])["cost_vases_displace"] == 0


def test_resting_vase_has_no_velocity_cost_unless_its_factor_is_set():
    assert with_vase({}, (1, 0), (1, 0)).step([0, 0])["cost_vases_velocity"] == 0
    assert with_vase({}, (1, 0), (1, 0), speed=0.5).step([0, 0])["cost_vases_velocity"] == 1
    world = with_vase({"vases_velocity_cost": 0.0}, (1, 0), (1, 0), speed=0.5)
    assert "cost_vases_velocity" not in world.step([0, 0])


@pytest.mark.parametrize(("timer", "cost"), [(0, 1.0), (1, 0.0)])
def test_wrong_button_costs_while_buttons_are_live(timer, cost):
    config = {"task": "button", "buttons_num": 2, "constrain_buttons": True}
    config["observe_buttons"] = True
    layout = {"buttons": [[0.0, 0.195], [1.0, 1.0]]}
    world = at_rest(config, layout, goal_button=1, buttons_timer=timer)
    assert world.observe().any() == (timer == 0)
    result = world.step([0, 0])
    assert result["cost_buttons"] == cost
    assert not result["goal_met"]
    assert at_rest(config, layout, goal_button=0, buttons_timer=timer).step([0, 0])["goal_met"]


def test_null_distance_silences_the_way_to_the_box():
    layout = {"goal": [[1.5, 0.0]], "box": [[0.6, 0.0]]}
    qpos = [0, 0, 0, 0.6, 0, 0.2, 1, 0, 0, 0]
    reward = {}
    for null_dist in (2, 4):
        world = ReferenceWorld({**POINT, "task": "push", "box_null_dist": null_dist})
        world.set_state(qpos, [0.5, *[0] * 8], layout=layout)
        reward[null_dist] = world.step([1, 0])["reward"]
    assert reward[2] > 5e-3
    assert abs(reward[4]) < 1e-4


def test_new_goal_costs_nothing():
    config = {"task": "goal", "reward_goal": 3.0, "goal_size": 0.3}
    world = at_rest(config, {"goal": [[0.2, 0.0]]})
    result = world.step([0, 0])
    assert result["goal_met"]
    np.testing.assert_allclose(result["reward"], 3.0, atol=1e-9)
    world.set_goal([2.0, 0.0])
    result = world.step([0, 0])
    assert not result["goal_met"]
    np.testing.assert_allclose(result["reward"], 0.0, atol=1e-9)
    assert world.buttons_timer == 9


def test_time_out_truncates_and_never_terminates():
    world = at_rest({"num_steps": 5}, {}, step_count=3)
    assert not world.step([0, 0])["truncated"]
    result = world.step([0, 0])
    assert result["truncated"]
    assert not result["terminated"]


def test_physics_failure_ends_the_episode(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs failures to a file where it is
    world = ReferenceWorld({**POINT, "reward_exception": -7.0})
    world.set_state([0, 0, 0], [np.nan, 0, 0], layout={})
    result = world.step([0, 0])
    assert (result["reward"], result["cost_exception"]) == (-7.0, 1.0)
    assert result["terminated"]


def test_gremlin_follows_its_circle_with_the_lag_of_the_weld():
    world = ReferenceWorld({**POINT, "gremlins_num": 1, "gremlins_travel": 0.3})
    pose = [1.0, -1.0, 0.1, np.cos(0.4), 0, 0, np.sin(0.4)]
    layout = {"gremlins": [[1.0, -1.0]]}
    world.set_state([0, 0, 0, *pose], np.zeros(9), layout=layout, gremlin_yaws=[0.8])
    for _ in range(100):
        world.step([0, 0])
    # MuJoCo's spring and damper for solref (0.02, 1.5) at full impedance 0.95: relative to a
    # target at rest, so that a target turning at 1 rad/s is followed late.
    stiffness = 1 / (0.95 * 0.02 * 1.5) ** 2
    damping = 2 / (0.95 * 0.02)
    turning = 0.3 * np.exp(-1j * (world.data.time - np.pi / 2))
    turning *= stiffness / (stiffness - 1 - 1j * damping)
    target = [1.0 + turning.real, -1.0 + turning.imag, 0.2]
    np.testing.assert_allclose(world.position("gremlin0"), target, atol=3e-3)
