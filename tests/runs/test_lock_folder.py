"""One writer per run: between processes, after they were killed, and where locks do not reach."""

import errno
import multiprocessing
import os
import signal
import time
from contextlib import contextmanager
from threading import Event, Thread

import pytest
from filelock import FileLock, SoftFileLease

from safe_rl.runs import folder as folder_module
from safe_rl.runs.folder import RunFolder, RunInUseError, lock_folder

FORK = multiprocessing.get_context("fork")
PATIENCE = 300
"""Seconds that nothing here takes, also on slow machines."""


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path)


def hold(folder, ready):
    with lock_folder(folder):
        ready.set()
        time.sleep(2 * PATIENCE)


@pytest.fixture
def holder(folder):
    """A process that holds the folder."""
    ready = FORK.Event()
    process = FORK.Process(target=hold, args=(folder, ready), daemon=True)
    process.start()
    assert ready.wait(PATIENCE)
    yield process
    process.kill()
    process.join(PATIENCE)


def test_the_second_is_told_who_the_first_is(folder, holder):
    with pytest.raises(RunInUseError, match=rf"process {holder.pid} on [^?]+\. Wait"):
        lock_folder(folder).__enter__()


def test_the_lock_dies_with_its_process(folder, holder):
    os.kill(holder.pid, signal.SIGKILL)
    holder.join(PATIENCE)
    assert SoftFileLease(folder.lease).pid == holder.pid
    start = time.monotonic()
    with lock_folder(folder):
        assert SoftFileLease(folder.lease).pid == os.getpid()
    assert time.monotonic() - start < folder_module.LEASE  # for which one elsewhere is waited for
    assert not folder.lease.exists()


def test_the_same_process_goes_on_and_the_outermost_lets_go(folder):
    with lock_folder(folder):
        with lock_folder(folder):
            pass
        assert folder.lease.exists()
    with lock_folder(folder):
        pass


def test_one_that_fails_lets_go_as_well(folder):
    with pytest.raises(FloatingPointError), lock_folder(folder):
        raise FloatingPointError
    assert not folder.lease.exists()


def outcome_of(folder, outcome):
    try:
        with lock_folder(folder):
            outcome.put("held")
    except RunInUseError:
        outcome.put("in use")


def assert_locked_for_others(folder):
    outcome = FORK.Queue()
    with lock_folder(folder):
        process = FORK.Process(target=outcome_of, args=(folder, outcome), daemon=True)
        process.start()
        assert outcome.get(timeout=PATIENCE) == "in use"
        process.join(PATIENCE)


def test_a_forked_process_does_not_hold_what_its_parent_holds(folder):
    assert_locked_for_others(folder)


def test_a_forked_process_that_outlives_the_holder_holds_nothing(folder):
    """The kernel's lock would go on in it: workers of a run that was killed."""

    def hold_and_fork(ready, child):
        with lock_folder(folder):
            grandchild = FORK.Process(target=time.sleep, args=(2 * PATIENCE,))
            grandchild.start()
            child.value = grandchild.pid
            ready.set()
            time.sleep(2 * PATIENCE)

    ready, child = FORK.Event(), FORK.Value("i")
    process = FORK.Process(target=hold_and_fork, args=(ready, child))
    process.start()
    try:
        assert ready.wait(PATIENCE)
        process.kill()
        process.join()  # with a time limit, it would wait for the other one as well
        with lock_folder(folder):
            pass
    finally:
        process.kill()
        if child.value:
            os.kill(child.value, signal.SIGKILL)


@pytest.fixture
def quick(monkeypatch):
    # not so quick that a busy machine renews a lease too late
    monkeypatch.setattr(folder_module, "LEASE", 3.0)


@contextmanager
def renewing(path):
    """As the holder of a lease does, wherever it is."""
    end = Event()

    def renew():
        while not end.wait(0.3):
            os.utime(path)

    thread = Thread(target=renew)
    thread.start()
    yield
    end.set()
    thread.join()


@pytest.mark.long
def test_a_writer_on_another_machine_that_shows_itself_is_left_alone(folder, quick):
    """As on a network file system whose locks stay on each machine."""
    lines = ("filelock/2", "pid=1", "host=elsewhere", "mode=lease", "token=a", "duration=3.0", "")
    folder.lease.write_text("\n".join(lines))
    with renewing(folder.lease), pytest.raises(RunInUseError, match="process 1 on elsewhere"):
        lock_folder(folder).__enter__()
    # and its place is taken when it does so no more
    with lock_folder(folder):
        assert SoftFileLease(folder.lease).pid == os.getpid()


@pytest.mark.long
@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_without_locks_the_writer_is_still_seen(folder, quick, monkeypatch, code):
    def refuse(self):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(FileLock, "acquire", refuse)
    assert_locked_for_others(folder)


@pytest.mark.parametrize("content", ["", "{", "[]", "null"])
def test_a_damaged_note_of_the_writer_stops_nobody(folder, content):
    folder.lease.write_text(content)
    with lock_folder(folder):
        pass
