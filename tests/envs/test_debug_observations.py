"""Observations for debugging: the raw state, as far as it does not tell where the origin is."""

import cmath

import mujoco
import numpy as np
import pytest
import torch
from crafting import after_random_steps

from safe_rl.envs import ConfigError, SafetyGymEnv

ROBOTS = ("point", "car", "doggo")


def make(robot: str, **keys) -> SafetyGymEnv:
    config = {"robot_base": robot, "task": "none", "observe_sensors": False, **keys}
    return SafetyGymEnv(config, num_envs=3, seed=0, sleep=False, num_threads=1)


def observed(env, observation: torch.Tensor, name: str) -> np.ndarray:
    return observation[:, env.observation_layout[name]].double().numpy()


def test_the_point_counts_from_where_it_started():
    env = make("point", observe_qpos=True, observe_qvel=True, vases_num=1)
    state = after_random_steps(env, num_steps=9)
    observation = env.set_state(state)["observation"]
    for row in range(3):
        x, y, yaw = state["start_pose"][row].tolist()
        qpos, qvel = state["qpos"][row].numpy(), state["qvel"][row].numpy()
        turn = cmath.exp(-1j * yaw)
        way, speed = turn * complex(qpos[0] - x, qpos[1] - y), turn * complex(*qvel[:2])
        want = [way.real, way.imag, qpos[2] - yaw, *qpos[3:]]
        np.testing.assert_allclose(observed(env, observation, "qpos")[row], want, atol=1e-6)
        want = [speed.real, speed.imag, *qvel[2:]]
        np.testing.assert_allclose(observed(env, observation, "qvel")[row], want, atol=1e-6)
    start = observed(env, env.reset()["observation"], "qpos")
    np.testing.assert_allclose(start[:, :3], 0.0, atol=1e-12)


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_centre_of_mass_is_in_the_middle_of_the_bodies(robot):
    env = make(robot, observe_com=True, vases_num=2, vases_density=50.0)
    after_random_steps(env, num_steps=5)
    state = env.get_state()
    observation = env.set_state(state)["observation"]
    world = env._world
    mass = torch.from_numpy(world.scene.model.body_mass)
    moving = [i for i in range(1, len(mass)) if world.scene.model.body_rootid[i] == 1]
    centres = torch.stack([_body_centres(world, row)[moving] for row in range(3)])
    want = (mass[moving, None] * centres).sum(1) / mass[moving].sum()
    np.testing.assert_allclose(observed(env, observation, "com"), want, atol=1e-6)


def _body_centres(world, row: int) -> torch.Tensor:
    data = mujoco.MjData(world.scene.model)
    data.qpos[:] = world.qpos[row]
    mujoco.mj_kinematics(world.scene.model, data)
    mujoco.mj_comPos(world.scene.model, data)
    return torch.from_numpy(data.xipos.copy())


@pytest.mark.parametrize("robot", ROBOTS)
def test_controls_are_the_clipped_action(robot):
    env = make(robot, observe_ctrl=True)
    action = 3.0 * env.action_spec.rand()
    assert float(action.abs().max()) > 1.0
    result = env.step(env.reset().set("action", action))["next", "observation"]
    assert torch.equal(result, action.clamp(-1, 1))
    assert not env.reset()["observation"].any()


def test_the_point_has_no_free_joint():
    with pytest.raises(ConfigError, match=r"'observe_freejoint'.*'point'.*'observe_qpos'"):
        make("point", observe_freejoint=True)


@pytest.mark.parametrize("robot", ROBOTS)
def test_sensors_can_be_left_out(robot):
    keys = {"observe_sensors": True, "sensors_obs": []}
    without = {"sensors_hinge_joints": False, "sensors_ball_joints": False, "observe_ctrl": True}
    assert list(make(robot, **keys, **without).observation_layout) == ["ctrl"]
    joints = {"point": 0, "car": 1 + 1, "doggo": 12 + 12}[robot]
    assert len(make(robot, **keys, observe_ctrl=True).observation_layout) == 1 + joints


def test_angles_are_pairs_or_numbers():
    components = make("doggo", observe_sensors=True, sensors_obs=[])
    numbers = make("doggo", observe_sensors=True, sensors_obs=[], sensors_angle_components=False)
    state = after_random_steps(components, num_steps=10)
    pairs = components.set_state(state)["observation"]
    numbers.reset()
    raw = numbers.set_state(state)["observation"]
    names = [name for name in numbers.observation_layout if name.startswith("jointpos")]
    assert len(names) == 12
    for name in names:
        angle = observed(numbers, raw, name)[:, 0]
        want = np.stack([np.sin(angle), np.cos(angle)], -1)
        np.testing.assert_allclose(observed(components, pairs, name), want, atol=1e-6)
        assert np.abs(angle).max() > 1e-3
