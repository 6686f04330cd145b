"""Natural lidar: rays against surfaces worked out by hand."""

import math

import numpy as np
import pytest
import torch
from crafting import arrange

from safe_rl.envs import SafetyGymEnv

BINS = 24
BARE = {
    "robot_base": "point",
    "task": "none",
    "observe_sensors": False,
    "lidar_type": "natural",
    "lidar_num_bins": BINS,
}
EVERYTHING = {
    **BARE,
    "task": "push",
    **{f"{kind}_num": 2 for kind in ("walls", "hazards", "vases", "pillars", "buttons")},
    "gremlins_num": 2,
    **{f"observe_{kind}": True for kind in ("walls", "hazards", "vases", "pillars", "buttons")},
    "observe_gremlins": True,
    "observe_box_lidar": True,
    "observe_goal_lidar": True,
    "walls_size": 0.2,
    "placements_extents": [-2.5, -2.5, 2.5, 2.5],
}
TIMESTEP = {"point": 0.002, "car": 0.004, "doggo": 0.01}


def make(config: dict, num_envs: int = 1, sleep: bool = False) -> SafetyGymEnv:
    env = SafetyGymEnv(config, num_envs=num_envs, seed=0, sleep=sleep, num_threads=1)
    env.reset()
    return env


def observe(env, **poses) -> dict[str, np.ndarray]:
    flat = env.set_state(arrange(env, **poses))["observation"][0].double().numpy()
    return {name: flat[columns] for name, columns in env.observation_layout.items()}


def ray_angles(yaw: float) -> np.ndarray:
    return yaw + 2 * np.pi * np.arange(BINS) / BINS


def square_distances(angles: np.ndarray, centre: tuple[float, float], half: float) -> np.ndarray:
    """Distance from the origin to an upright square along rays: the slab method."""
    ways = np.stack([np.cos(angles), np.sin(angles)])
    middle = np.array(centre)[:, None]
    with np.errstate(divide="ignore"):  # rays along a face never leave its slab
        bounds = np.stack([(middle - half) / ways, (middle + half) / ways])
    near, far = bounds.min(0).max(0), bounds.max(0).min(0)
    return np.where((near <= far) & (near > 0), near, np.inf)


def test_rays_pass_over_hazards_and_a_tilted_robot_sees_them():
    config = {**BARE, "robot_base": "car", "hazards_num": 1, "observe_hazards": True}
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
    config = {**BARE, "task": "button", "buttons_num": 1, "observe_buttons": True}
    env = make({**config, "observe_goal_lidar": True})
    got = observe(env, robot=(0, 0, 0), button0=(1, 0))
    assert got["buttons_lidar"][0] == pytest.approx(math.exp(-0.9), abs=1e-6)
    # The goal's rays see geom group 0: the floor, which level rays never reach.
    assert not got["goal_lidar"].any()
    state = arrange(env, robot=(0, 0, 0), button0=(1, 0))
    state["buttons_timer"].fill_(3)
    assert not env.set_state(state)["observation"].any()


def test_the_targets_of_gremlins_are_seen_once_they_circle():
    config = {**BARE, "robot_base": "doggo", "gremlins_num": 1, "gremlins_travel": 0.3}
    pinned = {"robot_locations": [[0, 0]], "gremlins_locations": [[1, -0.3]], "robot_rot": 0.0}
    pinned["gremlins_rots"] = [0.0]
    env = make({**config, **pinned, "gremlins_keepout": 0.1, "observe_gremlins": True})
    # Doggo's rays leave at 0.22 m, above the gremlin; at first its target stands inside it.
    assert not env.reset()["observation"].any()
    state = env.get_state()
    state["time"].fill_(TIMESTEP["doggo"])  # the target now runs, from 0.3 m along y
    got = env.set_state(state)["observation"][0].double().numpy()
    expected = square_distances(ray_angles(0.0), (1.0, 0.0), 0.1)
    np.testing.assert_allclose(got[0], np.exp(-expected[0]), atol=1e-6)


def rolled(env, num_steps: int) -> torch.Tensor:
    """The observation after random actions, always the same ones."""
    torch.manual_seed(0)
    tensordict = env.reset()
    for _ in range(num_steps):
        tensordict = env.step_mdp(env.step(env.rand_action(tensordict)))
    return tensordict["observation"]


def test_sleeping_objects_are_seen_where_they_are():
    awake, asleep = (rolled(make(EVERYTHING, 4, sleep), num_steps=40) for sleep in (False, True))
    torch.testing.assert_close(awake, asleep, atol=2e-3, rtol=0)
