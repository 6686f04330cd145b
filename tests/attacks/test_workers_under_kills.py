"""Killed workers of TorchRL and Gymnasium end a loop with an error, not in a hang."""

import multiprocessing
import os
import signal
from functools import partial

import gymnasium
import pytest
from torchrl.envs import ParallelEnv

from safe_rl.envs import make_env


def give_up(number, frame):
    raise AssertionError("it hangs")


@pytest.fixture(autouse=True)
def _patience():
    signal.signal(signal.SIGALRM, give_up)
    signal.alarm(600)  # workers import torch on a busy machine
    yield
    signal.alarm(0)
    for child in multiprocessing.active_children():
        child.kill()


def make_single():
    return gymnasium.make("Safexp-PointGoal1-v0")


def test_a_worker_of_parallel_env():
    env = ParallelEnv(2, partial(make_env, "PointGoal1", num_envs=1, num_threads=1, seed=0))
    step = env.reset()
    os.kill(env._workers[1].pid, signal.SIGKILL)
    with pytest.raises((RuntimeError, OSError, EOFError)):
        env.rollout(3, tensordict=step, auto_reset=False)


def test_a_worker_of_gymnasiums_vector_env():
    # forks are refused where threads of the physics are
    env = gymnasium.vector.AsyncVectorEnv([make_single] * 2, context="spawn")
    env.reset(seed=0)
    os.kill(env.processes[1].pid, signal.SIGKILL)
    with pytest.raises((RuntimeError, OSError, EOFError)):
        env.step(env.action_space.sample())
