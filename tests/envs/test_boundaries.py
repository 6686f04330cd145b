"""Circle and Run within boundaries: rewards and costs worked out by hand."""

import math

import numpy as np
import pytest
import torch
from crafting import arrange, step_from
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import EXTRAS, ConfigError, SafetyGymEnv
from safe_rl.envs.safety_gym.costs import boundary_cost, excess_speed

ROBOTS = ("Point", "Car", "Doggo")
NAMES = [f"{robot}{task}" for robot in ROBOTS for task in ("Run1", "Circle1", "Circle2")]
# No substeps: a step judges the state that it starts from.
FROZEN = {"robot_base": "point", "task": "none", "frameskip_binom_p": 0.0}


def make(name, **changes):
    config = EXTRAS[name].replace(**changes)
    env = SafetyGymEnv(config, num_envs=1, seed=0, sleep=False, num_threads=1)
    env.reset()
    return env


def at(env, x, y, velocity=(0.0, 0.0)):
    """What a step finds with the robot there, moving so."""
    state = arrange(env, robot=(x, y, 0.0))
    state["qvel"][:, :2] = torch.tensor(velocity, dtype=torch.float64)
    return step_from(env, state, *[0.0] * env.action_spec.shape[-1])


def test_outside_by_hand():
    xy = torch.tensor([[0.0, 9.0], [1.2, 0.0], [-1.5, -2.0], [1.0, 2.0]])
    # beyond x = ±1; beyond y = ±1.5 as well
    torch.testing.assert_close(boundary_cost(xy, 1.0, None), torch.tensor([0.0, 0.2, 0.5, 0.0]))
    torch.testing.assert_close(boundary_cost(xy, 1.0, 1.5), torch.tensor([7.5, 0.2, 1.0, 0.5]))
    torch.testing.assert_close(boundary_cost(xy, None, 1.5), torch.tensor([7.5, 0.0, 0.5, 0.5]))


def test_too_fast_by_hand():
    velocity = torch.tensor([[3.0, 4.0, 9.0], [0.6, 0.8, 0.0], [0.0, -1.5, 0.0]])
    torch.testing.assert_close(excess_speed(velocity, 1.0), torch.tensor([4.0, 0.0, 0.5]))


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
    got = at(make(name, frameskip_binom_p=0.0), *place)
    assert got["cost_boundary"].item() == got["cost"].item() == cost


def test_being_fast_costs_one_however_it_is_done():
    env = make("PointRun1", frameskip_binom_p=0.0)
    for velocity, cost in (((0.99, 0.0), 0.0), ((0.8, 0.61), 1.0), ((-1.01, 0.0), 1.0)):
        got = at(env, 0.0, 0.0, velocity)
        assert got["cost_velocity"].item() == got["cost"].item() == cost
    both = at(env, 0.0, 0.7, (2.0, 0.0))
    assert (both["cost_boundary"] + both["cost_velocity"]).item() == 2.0
    assert both["cost"].item() == 1.0  # indicators: whether anything costs


def test_magnitudes_are_metres_and_metres_per_second():
    keys = {"constrain_boundary": True, "boundary_x": 1.0, "boundary_y": 2.0}
    keys |= {"constrain_velocity": True, "velocity_limit": 0.5, "constrain_indicator": False}
    env = SafetyGymEnv({**FROZEN, **keys}, num_envs=1, seed=0, sleep=False)
    env.reset()
    got = at(env, 1.25, -2.5, (0.3, 0.4))
    assert math.isclose(got["cost_boundary"].item(), 0.75, rel_tol=1e-6)
    assert math.isclose(got["cost_velocity"].item(), 0.0, abs_tol=1e-6)
    got = at(env, 0.0, 0.0, (0.6, 0.8))
    assert math.isclose(got["cost_velocity"].item(), 0.5, rel_tol=1e-6)


def test_running_earns_metres_and_circling_the_papers_reward():
    env = make("PointRun1")
    state = arrange(env, robot=(0.0, 0.0, 0.0))
    before = env.set_state(state)
    step = env.step(before.set("action", torch.tensor([[1.0, 0.0]])))["next"]
    moved = env.get_state()["qpos"][0, 0].item()
    assert moved > 0
    assert math.isclose(step["reward"].item(), moved, rel_tol=1e-4)
    # v · (-y, x) / r / (1 + |r - 1.5|), a tenth of it, at r = 1.2 and a tangent of 0.5 m/s
    env = make("PointCircle1", frameskip_binom_p=0.0)
    got = at(env, 0.0, 1.2, (-0.5, 0.3))
    com = env.get_state()  # the Point's centre of mass is ahead of its body's
    assert com["qpos"].shape == (1, 3)
    assert math.isclose(got["reward"].item(), 0.1 * 0.5 / 1.3, rel_tol=0.05)


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


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"constrain_boundary": True}, "'constrain_boundary' needs 'boundary_x', 'boundary_y'"),
        ({"constrain_velocity": True}, "'constrain_velocity' needs 'velocity_limit'"),
        ({"boundary_x": 0.0}, "'boundary_x' must be greater than 0"),
    ],
)
def test_what_is_missing_is_said(keys, message):
    with pytest.raises(ConfigError, match=message):
        SafetyGymEnv({"robot_base": "point", **keys})


def test_boundaries_are_drawn_where_they_are():
    narrow, wide = (make("PointRun1", boundary_y=half) for half in (0.3, 0.9))
    pictures = [env.render(0, camera="fixedfar", width=120, height=90) for env in (narrow, wide)]
    free = make("PointRun", robot_placements=((-0.2, -0.2, 0.2, 0.2),), robot_keepout=0.0)
    free.set_state(narrow.get_state())
    plain = free.render(0, camera="fixedfar", width=120, height=90)
    assert (pictures[0] != plain).any()
    lines = [np.flatnonzero((p.astype(int) - plain).any((1, 2))) for p in pictures]
    assert np.ptp(lines[0]) < np.ptp(lines[1])
