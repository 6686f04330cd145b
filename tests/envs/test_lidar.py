"""Lidars, compasses and distances in situations small enough to work out by hand."""

import math

import numpy as np
import pytest
import torch
from crafting import arrange, make, observe

from safe_rl.envs.safety_gym.lidar import lidar_cells, pseudo_lidar

BARE = {"robot_base": "point", "task": "none", "sensors_obs": [], "lidar_num_bins": 8}


def test_lidars_are_there_without_objects_for_hazards_and_vases_only():
    kinds = ("hazards", "vases", "pillars", "buttons", "gremlins", "walls")
    env = make({**BARE, **{f"observe_{kind}": True for kind in kinds}})
    assert list(env.observation_layout) == ["hazards_lidar", "vases_lidar"]
    assert not env.reset()["observation"].any()


@pytest.mark.parametrize("components", [2, 3])
def test_compass_and_distance(components):
    config = {"task": "push", "observe_goal_comp": True, "observe_box_comp": True}
    config |= {"compass_shape": components, "observe_goal_dist": True}
    env = make({**BARE, **config})
    parts = observe(env, robot=(1, 1, math.pi / 2), goal=(1, 4), box=(-1, 1, 0))
    # In the robot's frame: the goal is 3 ahead and 0.06 up, the box 2 to the left and 0.1 up.
    for name, ego in (("goal_compass", (3, 0, 0.06)), ("box_compass", (0, 2, 0.1))):
        vector = np.array(ego[:components])
        want = vector / (np.linalg.norm(vector) + 0.001)
        np.testing.assert_allclose(parts[name], want, atol=1e-6)
    np.testing.assert_allclose(parts["goal_dist"], math.exp(-3.0), rtol=1e-6)


def one_by_one(x: float, y: float, num_bins: int) -> np.ndarray:
    """Readings of a lidar with aliasing that sees one object, as the paper describes them."""
    turn = (math.atan2(y, x) % (2 * math.pi)) / (2 * math.pi) * num_bins
    own = min(int(turn), num_bins - 1)
    reading, part = math.exp(-math.hypot(x, y)), turn - own
    seen = np.zeros(num_bins)
    for index, share in ((own, 1.0), (own + 1, part), (own - 1, 1.0 - part)):
        seen[index % num_bins] = max(seen[index % num_bins], share * reading)
    return seen


@pytest.mark.parametrize("num_bins", [*range(1, 30), 56, 122, 220])
def test_any_number_of_bins_closes_to_a_circle(num_bins):
    edges = [(x, y) for x in (1.0, -1.0) for y in (0.0, -0.0, -1e-17)] + [(0.0, -2.0)]
    xy = torch.cat([torch.tensor(edges).double(), torch.randn(60, 2, dtype=torch.float64)])
    group = torch.arange(len(xy)) % 2
    cells = lidar_cells(group, 2, num_bins, 3)
    seen = pseudo_lidar(
        torch.stack([xy.flip(1), xy, -xy]), cells, 2, num_bins, None, 1.0, alias=True
    )
    alone = [one_by_one(*place, num_bins) for place in xy.tolist()]
    want = [np.max([a for a, g in zip(alone, group, strict=True) if g == k], 0) for k in (0, 1)]
    np.testing.assert_allclose(seen[1].unflatten(0, (2, -1)), want, atol=1e-12)


# Natural lidar: rays against surfaces worked out by hand.
RAYS = {"robot_base": "point", "task": "none", "observe_sensors": False}
RAYS |= {"lidar_type": "natural", "lidar_num_bins": 24}


def test_rays_pass_over_hazards_and_a_tilted_robot_sees_them():
    config = {**RAYS, "robot_base": "car", "hazards_num": 1, "observe_hazards": True}
    env = make(config)
    assert not observe(env, robot=(0, 0), hazard0=(1.0, 0.0))["hazards_lidar"].any()
    state = arrange(env, robot=(0, 0), hazard0=(1.0, 0.0))
    pitch = 0.12  # the ray along x falls by 0.12 rad: from 0.1 m to the hazard's top at 0.03 m
    quat = torch.tensor([math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0])
    state["qpos"][:, 3:7] = quat.double()
    state["qpos"][:, 2] = 0.1
    got = env.set_state(state)["observation"][0, 0]
    # Down to the rim at x = 0.7 the ray is at 0.1 - 0.7·tan(0.12) = 0.0156: it meets the side.
    assert float(got) == pytest.approx(math.exp(-0.7 / math.cos(pitch)), abs=1e-6)


def test_a_button_that_is_the_goal_is_seen_by_its_own_lidar_only():
    config = {**RAYS, "task": "button", "buttons_num": 1, "observe_buttons": True}
    env = make({**config, "observe_goal_lidar": True})
    got = observe(env, robot=(0, 0, 0), button0=(1, 0))
    assert got["buttons_lidar"][0] == pytest.approx(math.exp(-0.9), abs=1e-6)
    # The goal's rays see geom group 0: the floor, which level rays never reach.
    assert not got["goal_lidar"].any()
    state = arrange(env, robot=(0, 0, 0), button0=(1, 0))
    state["buttons_timer"].fill_(3)
    assert not env.set_state(state)["observation"].any()


def test_the_targets_of_gremlins_are_seen_once_they_circle():
    config = {**RAYS, "robot_base": "doggo", "gremlins_num": 1, "gremlins_travel": 0.3}
    pinned = {"robot_locations": [[0, 0]], "gremlins_locations": [[1, -0.3]], "robot_rot": 0.0}
    pinned["gremlins_rots"] = [0.0]
    env = make({**config, **pinned, "gremlins_keepout": 0.1, "observe_gremlins": True})
    # Doggo's rays leave at 0.22 m, above the gremlin; at first its target stands inside it.
    assert not env.reset()["observation"].any()
    state = env.get_state()
    state["time"].fill_(0.01)  # a substep: the target now runs, from 0.3 m along y
    got = env.set_state(state)["observation"][0].double().numpy()
    np.testing.assert_allclose(got[0], math.exp(-0.9), atol=1e-6)
