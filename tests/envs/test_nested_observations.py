"""Observations that are not flattened: every component by its name, in its own shape."""

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import CatTensors, FlattenObservation
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import SUITE, SafetyGymEnv

NAMES = ("PointGoal2", "CarButton1", "DoggoPush2")


def make(name: str, **keys) -> SafetyGymEnv:
    config = SUITE[name].replace(**keys)
    return SafetyGymEnv(config, num_envs=3, seed=0, num_threads=1)


@pytest.mark.parametrize("name", NAMES)
def test_specs_hold(name):
    check_env_specs(make(name, observation_flatten=False))


@pytest.mark.parametrize("name", NAMES)
def test_components_are_the_columns_of_the_flat_observation(name):
    flat, nested = make(name), make(name, observation_flatten=False)
    torch.manual_seed(0)
    wanted = flat.rollout(6)
    torch.manual_seed(0)
    got = nested.rollout(6)
    assert torch.equal(got["next", "reward"], wanted["next", "reward"])
    assert set(got["observation"].keys()) == set(flat.observation_layout)
    for name, columns in flat.observation_layout.items():
        component = got["next", "observation", name]
        assert torch.equal(component.flatten(2), wanted["next", "observation"][..., columns])


def test_components_have_their_natural_shapes():
    observation = make("CarGoal1", observation_flatten=False, observe_qpos=True).reset()
    shapes = {name: tuple(value.shape[1:]) for name, value in observation["observation"].items()}
    assert shapes == {
        **dict.fromkeys(("accelerometer", "ballangvel_rear", "gyro", "velocimeter"), (3,)),
        "magnetometer": (3,),
        "ballquat_rear": (3, 3),
        **dict.fromkeys(("goal_lidar", "hazards_lidar", "vases_lidar"), (16,)),
        "qpos": (7 + 1 + 1 + 4 + 7,),
    }


def test_ball_joints_are_rotations():
    rotation = make("CarGoal0", observation_flatten=False).rollout(20)["observation"]
    rotation = rotation["ballquat_rear"]
    product = rotation @ rotation.transpose(-1, -2)
    torch.testing.assert_close(product, torch.eye(3).expand_as(product), atol=1e-5, rtol=0)
    assert not torch.allclose(rotation[:, -1], torch.eye(3).expand(3, 3, 3), atol=1e-2)


def test_later_steps_leave_earlier_results_alone():
    env = make("PointGoal1", observation_flatten=False)
    first = env.reset()
    kept = first.clone()
    env.rollout(3)
    assert all(torch.equal(first[key], kept[key]) for key in kept.keys(True, True))


def test_torchrl_can_put_it_together_again():
    nested = make("CarGoal1", observation_flatten=False)
    names = sorted(nested.observation_layout)
    keys = [("observation", name) for name in names]
    env = TransformedEnv(nested)
    env.append_transform(FlattenObservation(-2, -1, in_keys=[("observation", "ballquat_rear")]))
    env.append_transform(CatTensors(keys, "flat", sort=False))
    flat = make("CarGoal1")
    assert torch.equal(env.reset()["flat"], flat.reset()["observation"])
