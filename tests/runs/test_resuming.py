"""Runs that are killed and continued; what continues, what does not, and what it says."""

import multiprocessing
import os
import random
import shutil
import signal
import time
from functools import partial
from threading import Thread

import pytest
from omegaconf import OmegaConf
from point_mass import Forgetful, PointMass
from point_mass_runs import point_mass_trainer as trainer_of_point_mass
from run_configs import compose_config, point_mass_config, without_times
from torchrl.checkpoint import CheckpointError

from safe_rl.cli.sweeps import check_same_run
from safe_rl.envs import SafetyGymEnv
from safe_rl.runs.checkpoints import is_finished
from safe_rl.runs.run import Run
from safe_rl.training.building import build_trainer, seed_everything

pytestmark = pytest.mark.long

# episodes of 45 steps are open at the end of epochs of 30
SMALL = [
    *("env=PointGoal1", "algo=ppo_lagrangian", "env.num_steps=45", "frames=1800"),
    *("num_envs=4", "frames_per_batch=120", "model.hidden_sizes=[16]", "logger=none"),
    *("policy_update.minibatch_size=40", "policy_update.num_passes=2"),
    *("critic_update.minibatch_size=40", "critic_update.num_passes=2"),
]


def train(directory, *overrides):
    """What the command line does: start, or continue what is there."""
    config = compose_config(*SMALL, *overrides)
    seed_everything(config.seed, 1)
    env = SafetyGymEnv(
        {key: value for key, value in OmegaConf.to_container(config.env).items() if key != "name"},
        num_envs=config.num_envs, seed=config.seed, num_threads=1, sleep=True,
    )  # fmt: skip
    trainer = build_trainer(config, env, directory)
    if trainer.writer.run.has_begun:
        trainer.resume()
    trainer.run()


# A fork of this process would inherit the locks that its threads hold, and share that of progress
# bars, which a killed one leaves locked. The server that forks these has no threads and no bars.
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(["safe_rl.envs", "safe_rl.training.building"])
PATIENCE = 300
"""Seconds that nothing here takes, also on slow machines."""


def exit_code_of_training(directory, *overrides, kill_after=None):
    """That of a process of its own; only such a one can be killed."""
    process = SERVER.Process(
        target=train_to_be_killed, args=(directory, overrides, kill_after), daemon=True
    )
    process.start()
    process.join(PATIENCE)
    return process.exitcode


def train_to_be_killed(directory, overrides, kill_after):
    if kill_after is not None:
        Thread(target=end_after_rows, args=(directory, kill_after), daemon=True).start()
    train(directory, *overrides)


def end_after_rows(directory, number):
    """Kill this process at a random moment after it has written a number of rows.

    Another process might be too late on a busy machine.
    """
    while Run(directory).num_rows < number:
        time.sleep(0.002)
    time.sleep(random.Random(number).uniform(0, 0.1))
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_run_killed_several_times_leaves_the_table_of_one_that_was_not(tmp_path):
    """Kills of other algorithms and environments are in tests/attacks."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    train(whole)
    # one checkpoint per epoch, then one in several: what lies after it is done again
    for rows, interval in ((2, 0.0), (6, 0.2), (9, 0.4)):
        often = f"checkpoint.interval={interval}"
        assert exit_code_of_training(killed, often, kill_after=rows) == -signal.SIGKILL
    assert exit_code_of_training(killed) == 0
    table, expected = (without_times(folder / "progress.csv") for folder in (killed, whole))
    assert len(expected) == 1 + 15
    assert table == expected
    best, expected = (sorted((f / "checkpoints/best").iterdir()) for f in (killed, whole))
    assert [path.name for path in best] == [path.name for path in expected]
    assert not list(killed.rglob(".checkpoint-*"))


# episodes are open at the end of every epoch of 40 steps
point_mass_trainer = partial(trainer_of_point_mass, num_steps=27)


@pytest.mark.parametrize("kind", [PointMass, Forgetful])
def test_a_run_without_a_checkpoint_starts_over(kind, tmp_path, monkeypatch):
    monkeypatch.setattr("point_mass_runs.PointMass", kind)
    whole = point_mass_trainer(tmp_path / "whole", "frames=480")
    whole.run()
    begun = point_mass_trainer(tmp_path / "begun", "frames=480")
    with begun.writer.writing():
        begun._checkpoints.begin()
        begun.writer.add(begun.epoch(iter(begun.collector)))
    again = point_mass_trainer(tmp_path / "begun", "frames=480")
    assert again.writer.run.has_begun
    again.resume()
    again.run()
    tables = [without_times(tmp_path / name / "progress.csv") for name in ("begun", "whole")]
    assert tables[0] == tables[1]


@pytest.mark.parametrize("missing", ["checkpoints", "checkpoints/last"])
def test_a_run_whose_checkpoints_are_gone_is_left_as_it_is(tmp_path, missing):
    point_mass_trainer(tmp_path, "frames=640", "algo=ppo", "cost_limits={cost: 1000}").run()
    assert (tmp_path / "checkpoints" / "best").exists()
    shutil.rmtree(tmp_path / missing)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    trainer = point_mass_trainer(tmp_path, "frames=960", "algo=ppo", "cost_limits={cost: 1000}")
    with pytest.raises(CheckpointError, match=r"are gone.*4 epochs.*Put the checkpoints back"):
        trainer.resume()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_run_continued_with_what_cannot_train_keeps_its_configuration(tmp_path, monkeypatch):
    point_mass_trainer(tmp_path, "frames=640").run()
    before = (tmp_path / "config.yaml").read_text()
    broken = point_mass_trainer(tmp_path, "frames=960")
    broken.resume()

    def diverge(batch, episodes):
        raise FloatingPointError("not finite")

    monkeypatch.setattr(broken.algorithm, "learn", diverge)
    with pytest.raises(FloatingPointError):
        broken.run()
    assert (tmp_path / "config.yaml").read_text() == before


def test_a_damaged_checkpoint_gives_way_to_the_older_one(tmp_path):
    paper = "limits=null"  # a descent would depend on the frames of a run
    point_mass_trainer(tmp_path / "whole", paper, "frames=800").run()
    point_mass_trainer(tmp_path / "run", paper, "frames=640", "checkpoint.interval=0").run()
    older, newest = sorted((tmp_path / "run/checkpoints/last").iterdir())
    newest.write_bytes(newest.read_bytes()[:-100])
    assert is_finished(Run(tmp_path / "run").checkpoints("last"), 480)
    assert not is_finished(Run(tmp_path / "run").checkpoints("last"), 640)
    trainer = point_mass_trainer(tmp_path / "run", paper, "frames=800")
    with pytest.warns(UserWarning, match=f"{newest.name}.*older {older.name}"):
        trainer.resume()
    assert trainer.progress.steps == 480
    trainer.run()
    tables = [without_times(tmp_path / name / "progress.csv") for name in ("run", "whole")]
    assert tables[0] == tables[1]


def test_jobs_of_a_sweep_continue_with_the_same_settings_only(tmp_path):
    point_mass_trainer(tmp_path, "frames=160").run()
    check_same_run(point_mass_config("frames=160"), Run(tmp_path))
    longer, other = point_mass_config("frames=9000", "num_threads=2"), point_mass_config("seed=1")
    check_same_run(longer, Run(tmp_path))
    with pytest.raises(ValueError, match=r"seed: 0 -> 1.*hydra.sweep.dir"):
        check_same_run(other, Run(tmp_path))
