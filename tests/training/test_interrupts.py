"""Signals: what they end, when, and what they leave alone."""

import os
import pty
import select
import signal
import subprocess
import sys
import termios
import threading
from pathlib import Path

import pytest
from point_mass_runs import point_mass_trainer

from safe_rl.runs.table import read_table
from safe_rl.training.interrupts import StopRequest


def test_a_signal_ends_the_run_after_the_epoch_with_a_checkpoint(tmp_path):
    trainer = point_mass_trainer(tmp_path, "frames=100_000_000")
    record = trainer.folder.record

    def record_and_signal(row):
        record(row)
        if row["epoch"] == 3:
            signal.raise_signal(signal.SIGTERM)

    trainer.folder.record = record_and_signal
    handler = signal.getsignal(signal.SIGTERM)
    trainer.run()
    assert signal.getsignal(signal.SIGTERM) is handler
    assert read_table(tmp_path / "progress.csv")["epoch"] == [1, 2, 3]
    assert [path.name for path in (tmp_path / "checkpoints" / "last").iterdir()] == [
        "checkpoint-000000000480.torchrl"
    ]


def test_a_signal_in_the_last_epoch_interrupts_nothing(tmp_path):
    trainer = point_mass_trainer(tmp_path, "frames=160")
    record = trainer.folder.record

    def record_and_signal(row):
        record(row)
        signal.raise_signal(signal.SIGTERM)

    trainer.folder.record = record_and_signal
    trainer.run()
    assert trainer.progress.steps == 160
    assert trainer.interrupted_by is None


@pytest.fixture
def heeding_interrupts():
    """What a shell runs in the background ignores them."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("heeding_interrupts")
def test_a_second_interrupt_acts_at_once():
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.received
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_signals_are_left_alone_outside_the_main_thread():
    received = []

    def request():
        with StopRequest() as stop:
            received.append(stop.received)

    thread = threading.Thread(target=request)
    thread.start()
    thread.join()
    assert received == [None]


IN_A_TERMINAL = """
import fcntl, sys, termios
from pathlib import Path
from point_mass_runs import point_mass_trainer
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
trainer = point_mass_trainer(Path(sys.argv[1]), "frames=100_000_000")
trainer.run()
sys.exit(128 + trainer.interrupted_by)
"""


def test_a_closed_terminal_ends_the_run_after_the_epoch_with_a_checkpoint(tmp_path):
    near, far = pty.openpty()
    termios.tcsetwinsize(near, (24, 160))
    process = subprocess.Popen(
        [sys.executable, "-c", IN_A_TERMINAL, str(tmp_path)],
        stdin=far, stdout=far, stderr=far, start_new_session=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        cwd=Path(__file__).parents[2],
    )  # fmt: skip
    os.close(far)
    try:
        shown = b""
        while b"steps/s" not in shown:
            assert select.select([near], [], [], 300)[0], shown
            shown += os.read(near, 4096)
        os.close(near)
        assert process.wait(300) == 128 + signal.SIGHUP
    finally:
        process.kill()
    epochs = len(read_table(tmp_path / "progress.csv")["epoch"])
    (last,) = (tmp_path / "checkpoints" / "last").iterdir()
    assert last.name == f"checkpoint-{160 * epochs:012d}.torchrl"


def test_a_run_that_a_terminal_must_not_end_goes_on():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest() as stop:
            signal.raise_signal(signal.SIGHUP)
        assert not stop.received
    finally:
        signal.signal(signal.SIGHUP, before)
