"""The example of an environment of one's own does what it says, shortened."""

import csv
import importlib.util

import pytest
import torch
from registrations import undone
from run_configs import CONF

from safe_rl.envs import SafetyGymEnv

PATH = CONF.parent / "examples" / "custom_environment.py"
SHORT = (
    *("env.num_steps=20", "num_envs=2", "frames_per_batch=40", "frames=80", "logger=none"),
    *("model.hidden_sizes=[8]", "policy_update.minibatch_size=20"),
    *("critic_update.minibatch_size=20", "num_threads=1"),
)


@pytest.fixture
def example():
    spec = importlib.util.spec_from_file_location("custom_environment", PATH)
    module = importlib.util.module_from_spec(spec)
    with undone():
        spec.loader.exec_module(module)
        yield module


def test_it_trains_on_its_own_cost(example, tmp_path):
    assert "J_r" in example.main(list(SHORT), tmp_path)
    with (tmp_path / "progress.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["steps"] for row in rows] == ["40", "80"]
    assert {"episode_cost_mines", "multiplier_cost_mines"} <= rows[0].keys()


def test_danger_rises_towards_the_centre(example):
    robot = torch.tensor([[0.0, 0.0]])
    mines = torch.tensor([[[0.1, 0.0], [0.0, 0.3]]])
    torch.testing.assert_close(example.danger(robot, mines, 0.2), torch.tensor([0.5]))
    torch.testing.assert_close(example.danger(robot, mines, 0.4), torch.tensor([0.75]))
    torch.testing.assert_close(example.danger(robot, mines, 0.05), torch.tensor([0.0]))


def test_robots_meet_its_mines(example):
    example.register()
    env = SafetyGymEnv(example.POINT_MINES, num_envs=50, seed=0, num_threads=1)
    assert {"mines_lidar", "speed"} <= env.observation_layout.keys()
    rollout = env.rollout(200)
    assert 0 < float((rollout["next", "cost_mines"] > 0).float().mean()) < 0.5
    assert float(rollout["next", "cost_mines"].max()) <= 1.0
