"""Runs that learn from a replay buffer, killed at any moment and resumed by command."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from run_configs import without_times

ROOT = Path(__file__).parents[2]
SMALL = [
    *("env=PointGoal1", "env.num_steps=45", "num_threads=1", "frames=1800", "num_envs=4"),
    *("frames_per_batch=120", "replay.hidden_sizes=[16]", "exploration.random_steps=120"),
    *("memory.batch_size=32", "policy_update.updates_per_step=0.2", "logger=none"),
    *("certificate.episodes=0", "evaluation.interval=480", "evaluation.episodes=2"),
]


def command(*arguments):
    return subprocess.Popen(
        [sys.executable, "train.py", *arguments],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def said_by(*arguments):
    process = command(*arguments)
    words = process.communicate(timeout=240)[0]
    assert process.returncode == 0, words
    return words


def kill_after_rows(process, directory, number):
    table, deadline = directory / "progress.csv", time.monotonic() + 120
    while not (table.exists() and table.read_text().count("\n") > number):
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        ["algo=sac_lagrangian", "memory.n_steps=3"],
        ["algo=td3_lagrangian", "memory.prioritised={alpha: 0.6, beta: 0.4}"],
        ["algo=wcsac", "record=true"],
        ["algo=cal"],
    ],
)
def test_a_killed_run_that_keeps_its_replay_buffer_leaves_the_table_of_one_that_was_not(
    overrides, tmp_path
):
    keys = [*SMALL, *overrides, "memory.keep=true"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    said_by(*keys, f"hydra.run.dir={whole}")
    process = command(*keys, "checkpoint.interval=0", f"hydra.run.dir={killed}")
    kill_after_rows(process, killed, 4)
    # the next one writes checkpoints rarely: what lies after the last is done again
    process = command(f"resume={killed}", "checkpoint.interval=1000")
    kill_after_rows(process, killed, 9)
    words = said_by(f"resume={killed}")
    assert "of 1,800 frames" in words
    assert "not stored" not in words
    table, expected = (without_times(folder / "progress.csv") for folder in (killed, whole))
    assert len(expected) == 1 + 15
    assert table == expected


@pytest.mark.slow
def test_a_killed_run_without_its_replay_buffer_says_what_is_lost(tmp_path):
    keys = [*SMALL, "algo=sac_lagrangian", "checkpoint.interval=0", f"hydra.run.dir={tmp_path}"]
    kill_after_rows(command(*keys), tmp_path, 4)
    before = (tmp_path / "progress.csv").read_text().splitlines()[:4]
    words = said_by(f"resume={tmp_path}")
    assert "replay buffer are not stored (memory.keep=false)" in words
    assert "learning resumes when it holds 120 new ones" in words
    table = (tmp_path / "progress.csv").read_text().splitlines()
    assert len(table) == 1 + 15
    assert table[:4] == before
