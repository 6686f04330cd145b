"""The command train.py in this process, and any program in one of its own."""

import os
import subprocess
import sys
from pathlib import Path

from safe_rl.cli import train

ROOT = Path(__file__).parents[1]
SMALL = (
    *("env.num_steps=20", "num_envs=2", "frames_per_batch=40", "logger=none", "num_threads=1"),
    "model.hidden_sizes=[8]",
)
"""Overrides of a run whose epochs are two short episodes."""


def status_of(*arguments: str) -> object:
    """Its exit status, or the line that it ends with."""
    try:
        return train.main(arguments)
    except SystemExit as end:
        return end.code


def run_train(*arguments: str) -> None:
    """A run that comes to its end."""
    assert status_of(*arguments) == 0


def in_a_process(*words: str, status: int = 0, cwd: Path = ROOT, **environment: str) -> str:
    """What Python prints with these arguments, ending with that status."""
    # this process has a policy because it has imported safe_rl
    outside = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    result = subprocess.run(
        [sys.executable, *words],
        cwd=cwd, env=outside | environment, capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    printed = result.stdout + result.stderr
    assert result.returncode == status, printed
    return printed
