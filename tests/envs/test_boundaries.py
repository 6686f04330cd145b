"""Circle and Run within boundaries: rewards and costs worked out by hand."""

import math

import numpy as np
import pytest
import torch
from crafting import arrange, make, step_from
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import EXTRAS, SafetyGymEnv

ROBOTS = ("Point", "Car", "Doggo")
NAMES = [f"{robot}{task}" for robot in ROBOTS for task in ("Run1", "Circle1", "Circle2")]
# No substeps: a step judges the state that it starts from.
FROZEN = {"robot_base": "point", "task": "none", "frameskip_binom_p": 0.0}


def begin(name, **changes):
    return make(EXTRAS[name].replace(**changes))


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
    env = make({**FROZEN, **keys})
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


def test_boundaries_are_drawn_where_they_are():
    narrow, wide = (begin("PointRun1", boundary_y=half) for half in (0.3, 0.9))
    pictures = [env.render(0, camera="fixedfar", width=120, height=90) for env in (narrow, wide)]
    free = begin("PointRun", robot_placements=((-0.2, -0.2, 0.2, 0.2),), robot_keepout=0.0)
    free.set_state(narrow.get_state())
    plain = free.render(0, camera="fixedfar", width=120, height=90)
    assert (pictures[0] != plain).any()
    lines = [np.flatnonzero((p.astype(int) - plain).any((1, 2))) for p in pictures]
    assert np.ptp(lines[0]) < np.ptp(lines[1])
