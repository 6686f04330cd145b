"""A run from its beginning to its certificate: what stops it, what continues it, what is left."""

import os
import shutil
import signal
from weakref import ref

import pytest
import torch
from commands import SMALL
from run_configs import compose_config, without_times

from safe_rl.cli.sweeps import run_job
from safe_rl.evaluation import certifying
from safe_rl.runs.run import Run
from safe_rl.training.train import is_expected, train
from safe_rl.training.trainer import Trainer

TINY = (
    *(*SMALL, "frames=80", "policy_update.minibatch_size=20", "critic_update.minibatch_size=20"),
    *("certificate.ranking=2", "certificate.episodes=4", "certificate.tests=1"),
)
STOPPED = [lambda row: signal.raise_signal(signal.SIGTERM) if row["epoch"] == 2 else None]


def small(*overrides):
    return compose_config(*TINY, *overrides)


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    """A finished run that has not been certified."""
    return train(small("certificate.episodes=0"), tmp_path_factory.mktemp("usual") / "run")


@pytest.fixture
def run(usual, tmp_path):
    return Run(shutil.copytree(usual.directory, tmp_path / "run"))


def test_a_signal_in_the_last_epoch_leaves_the_certificate_to_the_next_start(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        train(small(), tmp_path / "run", callbacks=STOPPED)
    assert end.value.code == 128 + signal.SIGTERM
    assert "Interrupted before it was certified. To do so:" in capsys.readouterr().out
    run = Run(tmp_path / "run")
    assert run.is_finished
    assert run.certificate is None
    train(small(), run.directory, continues=True)
    assert run.certificate["most_episodes"] == 4
    # with nothing left to do, a signal in the last epoch interrupts nothing
    train(small("certificate.episodes=0"), tmp_path / "done", callbacks=STOPPED)


def test_a_finished_job_without_a_certificate_is_certified_by_the_next_sweep(tmp_path, monkeypatch):
    """Such as one that dies after its last checkpoint."""
    run = Run(tmp_path / "run")
    run_job(small("certificate.episodes=0"), None, run)
    assert run.certificate is None
    assert run_job(small(), None, run) > -1e9
    assert run.certificate["candidates"][-1] == 80
    monkeypatch.setattr(certifying, "certify", lambda *_, **__: pytest.fail("certified twice"))
    run_job(small(), None, run)


def test_a_run_is_tested_without_the_memory_of_its_training(tmp_path, monkeypatch):
    trainers, left, run = [], [], Trainer.run
    monkeypatch.setattr(Trainer, "run", lambda self: trainers.append(ref(self)) or run(self))
    monkeypatch.setattr(
        "safe_rl.training.train.certify_run", lambda *_, **__: left.append(trainers[0]())
    )
    train(small(), tmp_path / "run")
    assert left == [None]


def test_a_finished_run_is_tested_again_if_other_options_are_given(tmp_path, monkeypatch):
    run = train(small(), tmp_path / "run")
    more = "certificate.episodes=5"
    train(small(more), run.directory, continues=True)
    assert run.certificate["most_episodes"] == 5
    monkeypatch.setattr(certifying, "certify", lambda *_, **__: pytest.fail("tested again"))
    train(small(more), run.directory, continues=True)
    train(small(), run.directory, continues=True)


def test_a_finished_run_is_judged_by_the_episodes_of_its_environment(tmp_path, monkeypatch):
    """An environment without ``num_steps``: 500 steps, not 1,000."""
    words = ("env=gymnasium", "env.id=CartPole-v1", "env.outside={cost_far: [0, -1, 1]}")
    words += ("cost_limits={cost_far: 5}", "frames=500", "frames_per_batch=500", "num_envs=2")
    config = [*words, "logger=none", "num_threads=1", "certificate.ranking=2"]
    train(compose_config(*config, "certificate.episodes=0"), tmp_path / "run")
    tested = []
    monkeypatch.setattr(certifying, "certify", lambda directory, *_, **__: tested.append(directory))
    train(compose_config(*config, "certificate.episodes=5"), tmp_path / "run", continues=True)
    assert tested == [tmp_path / "run"]


def test_a_notebook_without_gradients_trains_as_usual(usual, tmp_path):
    with torch.no_grad():
        run = train(small("certificate.episodes=0"), tmp_path / "run")
    assert without_times(run.table_file) == without_times(usual.table_file)


def test_what_a_killed_process_left_is_removed(run):
    mark = "0123456789abcdef"
    left = [run.directory / f".config.{mark}.yaml", run.directory / f".curves.{mark}.png"]
    left.append(run.checkpoints_folder / "last" / f".checkpoint-000000000040.{mark}.torchrl")
    kept = run.directory / f".evaluation.{mark}.json"  # of an evaluation that is running
    old = run.directory / f".evaluation_old.{mark}.csv"
    for path in (*left, kept, old):
        path.touch()
    os.utime(old, (1e9, 1e9))
    train(small("certificate.episodes=0"), run.directory, continues=True)
    assert not any(path.exists() for path in (*left, old))
    assert kept.exists()


def test_a_run_that_cannot_begin_leaves_no_folder(tmp_path):
    (tmp_path / "made_by_hydra").mkdir()
    for name in ("new", "made_by_hydra"):
        with pytest.raises(ValueError, match="frames_per_batch"):
            train(small("frames_per_batch=3", "num_envs=2"), tmp_path / name)
        assert not (tmp_path / name).exists()


def test_a_run_in_the_place_of_another_is_refused_in_a_line(usual):
    with pytest.raises(FileExistsError) as caught:
        train(small(), usual.directory)
    assert is_expected(caught.value)
