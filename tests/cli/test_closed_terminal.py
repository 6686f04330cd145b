"""A command whose terminal is closed."""

import io
import os
import pty
import select
import subprocess
import sys
import termios

import pytest
from commands import ROOT, SMALL

from safe_rl.cli import certify
from safe_rl.runs.table import read_table

pytestmark = pytest.mark.long

IN_A_TERMINAL = """
import fcntl, signal, sys, termios
signal.signal(signal.SIGHUP, signal.SIG_IGN)
from safe_rl.cli.train import main
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
sys.exit(main())
"""


def close_terminal(run, *settings):
    """Start a run in a terminal, close that after the first epoch; returns the exit status."""
    near, far = pty.openpty()
    termios.tcsetwinsize(near, (24, 160))
    process = subprocess.Popen(
        [sys.executable, "-c", IN_A_TERMINAL, *SMALL, *settings, f"hydra.run.dir={run}"],
        stdin=far, stdout=far, stderr=far, start_new_session=True, cwd=ROOT,
    )  # fmt: skip
    os.close(far)
    try:
        shown = b""
        while b"steps/s" not in shown:
            assert select.select([near], [], [], 300)[0], shown
            shown += os.read(near, 4096)
        os.close(near)
        return process.wait(300)
    finally:
        process.kill()
        process.wait()


def test_a_run_that_ignores_the_signal_is_certified(tmp_path):
    """Printing the outcome into the terminal that is gone ended it with status 1."""
    test = ["certificate.episodes=2", "certificate.ranking=2", "certificate.tests=1"]
    run = tmp_path / "run"
    limit = "cost_limits={cost: 1000}"
    assert close_terminal(run, "frames=400", limit, *test) == 0
    assert len(read_table(run / "progress.csv")["epoch"]) == 10
    assert (run / "certificate.json").is_file()


def test_closed_streams_and_narrow_encodings_end_no_run(tmp_path, monkeypatch):
    """A closed standard error ended tqdm, and ASCII a certificate after it was done."""
    words = [sys.executable, "train.py", *SMALL, "frames=80", f"hydra.run.dir={tmp_path / 'run'}"]
    subprocess.run(["sh", "-c", '"$@" 2>&-', "sh", *words], cwd=ROOT, check=True)
    assert len(read_table(tmp_path / "run" / "progress.csv")["steps"]) == 2
    changes = ["certificate.episodes=2", "certificate.ranking=2"]
    ascii_only = io.TextIOWrapper(written := io.BytesIO(), encoding="ascii", write_through=True)
    monkeypatch.setattr(sys, "stdout", ascii_only)
    assert certify.main([str(tmp_path / "run"), *changes]) == 0
    assert b"mean_cost \\u2264" in written.getvalue()
