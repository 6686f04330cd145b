"""Rewards, goals and boundaries in situations small enough to work out by hand."""

import math

import pytest
import torch
from crafting import arrange, make, step_from
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import SafetyGymEnv, resolve
from safe_rl.envs.safety_gym.tasks import circle_speed

POINT = {"robot_base": "point", "placements_extents": [-4, -4, 4, 4]}
# Without substeps, a step computes the costs and rewards of the state that it starts from.
FROZEN = {**POINT, "frameskip_binom_p": 0.0}
POINT_HEIGHT = 0.1


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


NAMES = ("PointRun1", "CarCircle1", "DoggoCircle2")


def begin(name, **changes):
    return make(resolve(name).replace(**changes))


def at(env, x, y, velocity=(0.0, 0.0)):
    """What a step finds with the robot there, moving so."""
    state = arrange(env, robot=(x, y, 0.0))
    state["qvel"][:, :2] = torch.tensor(velocity, dtype=torch.float64)
    return step_from(env, state, *[0.0] * env.action_spec.shape[-1])


@pytest.mark.parametrize(
    ("name", "place", "cost"),
    [
        ("PointCircle1", (1.124, 0.0), 0.0),
        ("PointCircle1", (-1.126, 0.0), 1.0),
        ("PointCircle1", (0.0, 1.4), 0.0),
        ("PointCircle2", (0.0, 1.4), 1.0),
        ("PointCircle2", (0.0, -1.124), 0.0),
        ("CarCircle2", (1.3, -1.3), 1.0),
        ("PointRun1", (9.0, 0.499), 0.0),
        ("PointRun1", (9.0, -0.501), 1.0),
    ],
)
def test_leaving_the_boundary_costs_one(name, place, cost):
    got = at(begin(name, frameskip_binom_p=0.0), *place)
    assert got["cost_boundary"].item() == got["cost"].item() == cost


def test_being_fast_costs_one_however_it_is_done():
    env = begin("PointRun1", frameskip_binom_p=0.0)
    for velocity, cost in (((0.99, 0.0), 0.0), ((0.8, 0.61), 1.0), ((-1.01, 0.0), 1.0)):
        got = at(env, 0.0, 0.0, velocity)
        assert got["cost_velocity"].item() == got["cost"].item() == cost
    both = at(env, 0.0, 0.7, (2.0, 0.0))
    assert (both["cost_boundary"] + both["cost_velocity"]).item() == 2.0
    assert both["cost"].item() == 1.0  # indicators: whether anything costs


def test_magnitudes_are_metres_and_metres_per_second():
    keys = {"constrain_boundary": True, "boundary_x": 1.0, "boundary_y": 2.0}
    keys |= {"constrain_velocity": True, "velocity_limit": 0.5, "constrain_indicator": False}
    env = make({**FROZEN, "task": "none", **keys})
    got = at(env, 1.25, -2.5, (0.3, 0.4))
    assert math.isclose(got["cost_boundary"].item(), 0.75, rel_tol=1e-6)
    assert math.isclose(got["cost_velocity"].item(), 0.0, abs_tol=1e-6)
    got = at(env, 0.0, 0.0, (0.6, 0.8))
    assert math.isclose(got["cost_velocity"].item(), 0.5, rel_tol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_every_row_keeps_its_specs_and_lasts_500_steps(name):
    env = SafetyGymEnv(name, num_envs=2, seed=0)
    assert env.max_episode_steps == 500
    check_env_specs(env)
    start = env.reset()
    assert not start["truncated"].any()
    half = 0.2 if "Run" in name else 0.8
    xy = env.get_positions()["robot"][..., :2]
    assert xy.abs().max() <= half + 1e-6
    expected = {"cost", "cost_boundary", "cost_exception"}
    assert set(env.cost_keys) == expected | ({"cost_velocity"} if "Run" in name else set())


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
