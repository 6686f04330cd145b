"""Environments whose actions are choices, from the command line."""

import json

import gymnasium_envs  # noqa: F401, registers Boxes-v0
import pytest
import torch
import yaml
from commands import run_train

from safe_rl.cli import evaluate
from safe_rl.runs.table import read_table

pytestmark = pytest.mark.long

SMALL = (
    *("env=gymnasium", "logger=none", "num_threads=1", "certificate.episodes=0", "num_envs=4"),
    *("model.hidden_sizes=[8]", "frames_per_batch=200", "critic_update.minibatch_size=50"),
)
CART_POLE = ("env.id=CartPole-v1", "env.outside={cost_position: [0, -0.05, 0.05]}")


def test_a_cart_learns_to_stay_within_a_range(tmp_path):
    run_train(*SMALL, *CART_POLE, "algo=cpo", "frames=600", f"hydra.run.dir={tmp_path}")
    env = yaml.safe_load((tmp_path / "config.yaml").read_text())["env"]
    assert env["outside"] == {"cost_position": [0, -0.05, 0.05]}
    table = read_table(tmp_path / "progress.csv")
    assert all(
        0 < cost <= length
        for cost, length in zip(
            table["episode_cost_position"], table["episode_length"], strict=True
        )
    )
    assert all(kl > 0 for kl in table["policy_kl"])
    # a policy that begins with even odds has the entropy log 2
    assert table["policy_entropy"][0] == pytest.approx(torch.tensor(2.0).log().item(), abs=0.05)
    run_train(f"resume={tmp_path}", "frames=800")
    assert read_table(tmp_path / "progress.csv")["steps"] == [200, 400, 600, 800]
    options = ["episodes=4", "num_envs=2", "deterministic=true"]
    assert evaluate.main([str(tmp_path), *options]) == 0
    assert json.loads((tmp_path / "evaluation.json").read_text())["environment"] == "CartPole-v1"


@pytest.mark.slow
def test_several_choices_at_once_are_trained_in_processes_too(tmp_path):
    """The environment itself refuses actions that it does not have."""
    # imported by the workers, too, which would not know Boxes-v0
    own = ("import=gymnasium_envs", "env.id=Boxes-v0", "cost_limits={cost: 6}", "frames=400")
    own += ("policy_update.minibatch_size=50", "collector=process", f"hydra.run.dir={tmp_path}")
    run_train(*SMALL, *own)
    table = read_table(tmp_path / "progress.csv")
    assert table["steps"] == [200, 400]
    # what every step earns is at most 3, and costs at most 1.5; neither is ever all or nothing
    assert all(0 < value < 30 for value in table["episode_return"])
    assert all(0 < cost < 15 for cost in table["episode_cost"])
