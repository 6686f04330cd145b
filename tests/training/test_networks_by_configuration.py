"""Networks and actions of other kinds, from the command line: trained, resumed, evaluated."""

import json
from functools import partial

import gymnasium_envs  # noqa: F401, registers Recall-v0 and Boxes-v0
import pytest
import torch
import yaml
from commands import run_train
from point_mass import PointMass  # noqa: F401
from run_configs import compose_config, without_times

from safe_rl.algorithms.algorithm_contract import find_algorithm
from safe_rl.cli import evaluate
from safe_rl.collectors import read_dataset
from safe_rl.envs import make_env
from safe_rl.runs.table import read_table
from safe_rl.training.building import build_trainer, seed_everything

pytestmark = pytest.mark.long

SMALL = (
    *("logger=none", "num_threads=1", "certificate.episodes=0", "num_envs=4", "env.num_steps=25"),
    *("model.hidden_sizes=[8]", "frames_per_batch=160", "critic_update.minibatch_size=40"),
    "critic_update.num_passes=2",
)
PPO = ("policy_update.minibatch_size=80", "policy_update.num_passes=2")
DICTIONARY = ("model=dict", "model.encoders.vector=[4]", "env.observation_flatten=false")
CHOICES = {
    "dictionary": (*DICTIONARY, *PPO),
    "memory": ("model=gru", "model.memory.size=4", "model.normalise=10", "algo=cpo"),
}


@pytest.mark.parametrize("kind", CHOICES)
def test_runs_resume_to_the_last_digit(kind, tmp_path):
    """Batches of 40 steps per row cut episodes of 25 at different points."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    run_train(*SMALL, *CHOICES[kind], "frames=640", f"hydra.run.dir={whole}")
    run_train(*SMALL, *CHOICES[kind], "frames=320", f"hydra.run.dir={parts}")
    run_train(f"resume={parts}", "frames=640")
    assert without_times(whole / "progress.csv") == without_times(parts / "progress.csv")
    assert evaluate.main([str(parts), "episodes=4", "num_envs=2", "deterministic=true"]) == 0
    assert json.loads((parts / "evaluation.json").read_text())["episodes"] == 4


def test_workers_normalise_as_the_first_process_does(tmp_path):
    """What they are sent before every batch is also what they divide by."""
    config = compose_config(
        *(*SMALL, *PPO, "env=PointGoal1", "model.normalise=10", "frames=480"),
        *("collector=process", "collector.num_collectors=1"),
    )
    seed_everything(0, 1)
    goal = {"name": "PointGoal1", "robot_base": "point", "num_steps": 25}
    make = partial(make_env, goal, seed=0)
    trainer = build_trainer(config, make(num_envs=4), tmp_path, make)
    try:
        batches = iter(trainer.collector)
        for _ in range(2):
            trainer.epoch(batches)
        batch = next(batches)
        actor = trainer.algorithm.actor
        with torch.no_grad():
            torch.testing.assert_close(actor(batch.select("observation"))["loc"], batch["loc"])
    finally:
        trainer.close()


@pytest.mark.parametrize("choice", ["+model.normalise=10", "model=gru"])
def test_off_policy_algorithms_neither_normalise_nor_remember(choice):
    config = compose_config("algo=sac", "env=PointGoal1", choice)
    with pytest.raises(ValueError, match=r"algo=sac.*model\.\w+ is for on-policy algorithms"):
        find_algorithm(config).from_config(config, make_env("PointGoal1", num_envs=2, seed=0))


@pytest.mark.slow
@pytest.mark.parametrize(("model", "lowest", "highest"), [("mlp", 3.5, 5.0), ("gru", 7.0, 8.0)])
def test_a_memory_recalls_what_was_shown_once(model, lowest, highest, tmp_path):
    """Eight steps, of which the side was shown before the first; half of the others is luck."""
    run_train(
        *("env=gymnasium", "env.id=Recall-v0", "algo=ppo", f"model={model}", "num_envs=20"),
        *("frames_per_batch=1600", "frames=64_000", "model.hidden_sizes=[16]", "logger=none"),
        *("policy_update.minibatch_size=320", "critic_update.minibatch_size=320"),
        *("policy_update.max_kl=0.05", "num_threads=1", f"hydra.run.dir={tmp_path}"),
    )
    table = read_table(tmp_path / "progress.csv")
    assert lowest < sum(table["episode_return"][-5:]) / 5 <= highest


def test_workers_of_a_resumed_run_do_not_begin_with_its_first_episodes_again(tmp_path):
    """They have no stored states, and get new ones, again at different steps of their episodes."""
    keys = ("env=PointGoal1", "collector=process", "collector.num_collectors=1", "record=true")
    run_train(*SMALL, *PPO, *keys, "frames=160", f"hydra.run.dir={tmp_path}")
    run_train(f"resume={tmp_path}", "frames=320")
    steps = read_dataset(tmp_path / "transitions")
    assert steps.shape == (4, 80)
    first, resumed = steps["observation"][:, 0], steps["observation"][:, 40]
    assert not (first == resumed).all(-1).any()
    for part in steps["next", "done"].squeeze(-1).split(40, dim=1):
        assert part.int().argmax(1).tolist() == [24, 18, 12, 6]


CHOOSING = (  # environments whose actions are choices
    *("env=gymnasium", "logger=none", "num_threads=1", "certificate.episodes=0", "num_envs=4"),
    *("model.hidden_sizes=[8]", "frames_per_batch=200", "critic_update.minibatch_size=50"),
)
CART_POLE = ("env.id=CartPole-v1", "env.outside={cost_position: [0, -0.05, 0.05]}")


def test_a_cart_learns_to_stay_within_a_range(tmp_path):
    run_train(*CHOOSING, *CART_POLE, "algo=cpo", "frames=600", f"hydra.run.dir={tmp_path}")
    env = yaml.safe_load((tmp_path / "config.yaml").read_text())["env"]
    assert env["outside"] == {"cost_position": [0, -0.05, 0.05]}
    table = read_table(tmp_path / "progress.csv")
    pairs = zip(table["episode_cost_position"], table["episode_length"], strict=True)
    assert all(0 < cost <= length for cost, length in pairs)
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
    run_train(*CHOOSING, *own)
    table = read_table(tmp_path / "progress.csv")
    assert table["steps"] == [200, 400]
    # what every step earns is at most 3, and costs at most 1.5; neither is ever all or nothing
    assert all(0 < value < 30 for value in table["episode_return"])
    assert all(0 < cost < 15 for cost in table["episode_cost"])
