"""A command whose terminal is closed."""

import os
import pty
import select
import signal
import subprocess
import sys
import termios
from pathlib import Path

from safe_rl.runs.table import read_table

IN_A_TERMINAL = """
import fcntl, signal, sys, termios
# what ran the tests may ignore it, as nohup does, and a process inherits that
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from safe_rl.cli.train import main
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
sys.exit(main())
"""
SMALL = ["env=PointGoal1", "algo=ppo_lagrangian", "frames=1_000_000", "logger=none", "num_envs=2",
         "frames_per_batch=200", "env.num_steps=50", "model.hidden_sizes=[8]"]  # fmt: skip


def test_training_ends_after_the_epoch_with_a_checkpoint(tmp_path):
    near, far = pty.openpty()
    termios.tcsetwinsize(near, (24, 160))
    process = subprocess.Popen(
        [sys.executable, "-c", IN_A_TERMINAL, *SMALL, f"hydra.run.dir={tmp_path / 'run'}"],
        stdin=far, stdout=far, stderr=far, start_new_session=True, cwd=Path(__file__).parents[2],
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
        process.wait()
    epochs = len(read_table(tmp_path / "run" / "progress.csv")["epoch"])
    *_, last = sorted((tmp_path / "run" / "checkpoints" / "last").iterdir())
    assert last.name == f"checkpoint-{200 * epochs:012d}.torchrl"
