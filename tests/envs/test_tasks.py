"""Rewards and goals in situations small enough to work out by hand."""

import math

import pytest
import torch
from crafting import arrange, make, step_from

from safe_rl.envs.safety_gym.tasks import circle_speed

POINT = {"robot_base": "point", "placements_extents": [-4, -4, 4, 4]}
FROZEN = {**POINT, "frameskip_binom_p": 0.0}
GOAL_HEIGHT = 0.3 / 2 + 0.01
POINT_HEIGHT = 0.1


@pytest.mark.parametrize(("distance", "met"), [(0.2999, True), (0.3001, False)])
def test_a_goal_is_met_within_its_radius(distance, met):
    env = make({**FROZEN, "goal_size": 0.3, "reward_goal": 5.0})
    state = arrange(env, robot=(0, 0, 0), goal=(0, distance))
    got = step_from(env, state, 0, 0)
    assert bool(got["goal_met"]) == met
    assert float(got["reward"]) == (5.0 if met else 0.0)
    # Height does not count.
    assert abs(float(state["goal_pos"][0, 2]) - GOAL_HEIGHT) < 1e-12


@pytest.mark.parametrize(("null_dist", "rewarded"), [(2.0, True), (3.0, False)])
def test_the_way_to_the_box_is_rewarded_beyond_the_null_distance(null_dist, rewarded):
    """The box, half side 0.2, is 0.5 away: 2.5 null distances."""
    config = {**POINT, "task": "push", "box_null_dist": null_dist, "reward_box_goal": 0.0}
    env = make({**config, "reward_box_dist": 3.0})
    state = arrange(env, robot=(0, 0, 0), box=(0.5, 0, 0), goal=(3, 0))
    state["qvel"][:, 0] = -1.0
    got = step_from(env, state, 0, 0)
    x, z = env.get_state()["qpos"][0, [0, 5]].tolist()
    before = math.hypot(0.5, 0.2 - POINT_HEIGHT)
    lost = math.hypot(0.5 - x, z - POINT_HEIGHT) - before
    assert 0.01 < lost < 0.03
    expected = -3.0 * lost if rewarded else 0.0
    assert math.isclose(float(got["reward"]), expected, rel_tol=1e-4, abs_tol=1e-6)


@pytest.mark.parametrize(("offset", "met"), [(0.295, True), (0.3, False)])
def test_a_box_is_in_its_goal_by_the_distance_in_space(offset, met):
    """Box and goal are 0.04 apart in height: 0.2977 and 0.3027 in space."""
    env = make({**FROZEN, "task": "push"})
    got = step_from(env, arrange(env, robot=(3, 3, 0), goal=(0, 0), box=(offset, 0, 0)), 0, 0)
    assert bool(got["goal_met"]) == met


@pytest.mark.parametrize("sign", [-1, 1])
def test_dense_rewards_are_clipped_before_the_goal_is_added(sign):
    config = {**POINT, "goal_size": 10.0, "reward_distance": 1e4, "reward_clip": 3.0}
    env = make(config)
    state = arrange(env, robot=(0, 0, 0), goal=(3, 0))
    state["qvel"][:, 0] = 1.0 * sign
    assert float(step_from(env, state, 0, 0)["reward"]) == 3.0 * sign + 1.0


def test_the_very_centre_of_the_circle_is_no_motion_about_it():
    centre, velocity = torch.zeros(1, 2).double(), torch.tensor([[1.0, -2.0]]).double()
    assert circle_speed(centre, velocity, 1.5).tolist() == [0.0]
    near = torch.tensor([[1e-9, 0.0]]).double()  # all of the speed across, less the distance
    torch.testing.assert_close(circle_speed(near, velocity, 1.5), torch.tensor([-2 / 2.5]).double())
