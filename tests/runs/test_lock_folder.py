"""One writer per run: between processes, after they were killed, and where there are no locks."""

import errno
import multiprocessing
import os
import signal
import time

import pytest
from filelock import FileLock
from omegaconf import OmegaConf
from point_mass_runs import point_mass_trainer

from safe_rl.evaluation import certifying
from safe_rl.runs.folder import RunInUseError, lock_folder
from safe_rl.runs.run import Run

FORK = multiprocessing.get_context("fork")
PATIENCE = 300
"""Seconds that nothing here takes, also on slow machines."""


@pytest.fixture
def folder(tmp_path):
    return Run(tmp_path)


def hold(folder, ready):
    with lock_folder(folder.lock_file):
        ready.set()
        time.sleep(2 * PATIENCE)


@pytest.fixture
def holder(folder):
    ready = FORK.Event()
    process = FORK.Process(target=hold, args=(folder, ready), daemon=True)
    process.start()
    assert ready.wait(PATIENCE)
    yield process
    process.kill()
    process.join(PATIENCE)


def test_the_second_is_told_who_the_first_is(folder, holder):
    with pytest.raises(RunInUseError, match=rf"process {holder.pid} on .+\. Wait"):
        lock_folder(folder.lock_file).__enter__()


def test_a_run_that_is_held_is_neither_trained_nor_certified(folder, holder, monkeypatch):
    trainer = point_mass_trainer(folder.directory, "frames=160", "certificate.episodes=0")
    with pytest.raises(RunInUseError, match=f"process {holder.pid}"):
        trainer.run()
    assert not folder.has_begun
    OmegaConf.save(trainer.writer.config, folder.config_file, resolve=True)
    monkeypatch.setattr(certifying, "certify", lambda *_, **__: pytest.fail("without the lock"))
    with pytest.raises(RunInUseError):
        certifying.certify_run(folder.directory)


def test_the_lock_dies_with_its_process(folder, holder):
    os.kill(holder.pid, signal.SIGKILL)
    holder.join(PATIENCE)
    with lock_folder(folder.lock_file):
        assert folder.lock_file.read_text().startswith(f"process {os.getpid()} on ")


def outcome_of(folder, outcome):
    try:
        with lock_folder(folder.lock_file):
            outcome.put("held")
    except RunInUseError:
        outcome.put("in use")


def assert_others_find(folder, expected):
    outcome = FORK.Queue()
    process = FORK.Process(target=outcome_of, args=(folder, outcome), daemon=True)
    process.start()
    assert outcome.get(timeout=PATIENCE) == expected
    process.join(PATIENCE)


def test_the_outermost_block_lets_go_also_if_it_fails(folder):
    def fail():
        with lock_folder(folder.lock_file):
            with lock_folder(Run(folder.directory / ".." / folder.directory.name).lock_file):
                pass
            assert_others_find(folder, "in use")
            raise FloatingPointError

    with pytest.raises(FloatingPointError):
        fail()
    assert_others_find(folder, "held")


def test_a_forked_process_that_outlives_the_holder_holds_nothing(folder):
    """Such as the workers of a run that was killed."""

    def outlive(ready, child):  # runs once the fork has let go of the lock
        child.value = os.getpid()
        ready.set()
        time.sleep(2 * PATIENCE)

    def hold_and_fork(ready, child):
        with lock_folder(folder.lock_file):
            FORK.Process(target=outlive, args=(ready, child)).start()
            time.sleep(2 * PATIENCE)

    ready, child = FORK.Event(), FORK.Value("i")
    process = FORK.Process(target=hold_and_fork, args=(ready, child))
    process.start()
    try:
        assert ready.wait(PATIENCE)
        process.kill()
        process.join()  # with a time limit, it would wait for the other one as well
        with lock_folder(folder.lock_file):
            pass
    finally:
        process.kill()
        if child.value:
            os.kill(child.value, signal.SIGKILL)


@pytest.mark.parametrize("code", [errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_has_runs_as_well(folder, monkeypatch, code):
    def refuse(self):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(FileLock, "acquire", refuse)
    with lock_folder(folder.lock_file):
        pass
