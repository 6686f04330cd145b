"""Resets, steps and environments leave no memory behind."""

import gc
import weakref
from pathlib import Path

import pytest

from safe_rl.envs import SafetyGymEnv

STATUS = Path("/proc/self/statm")
PAGE = 4096  # bytes


def resident() -> int:
    """Memory of this process [bytes]."""
    return int(STATUS.read_text().split()[1]) * PAGE


@pytest.mark.skipif(not STATUS.exists(), reason="reads the memory of a process as Linux tells it")
@pytest.mark.parametrize("name", ["PointGoal1", "PointButton0"])
def test_resets_and_steps_do_not_grow_memory(name):
    env = SafetyGymEnv(name, num_envs=64, seed=0, num_threads=1)
    actions = env.action_spec.rand((2,))

    def episodes(number: int) -> None:
        for _ in range(number):
            tensordict = env.reset()
            for action in actions:
                tensordict = env.step_mdp(env.step(tensordict.set("action", action)))

    episodes(10)
    number, growth = 15, []
    for _ in range(3):
        before = resident()
        episodes(number)
        growth.append(resident() - before)
    # A leak shows every time, what an allocator takes does not. Kept observations are the least.
    kept = number * 64 * env.observation_spec["observation"].shape[-1] * 4
    assert min(growth) < 0.5 * kept


def test_nothing_keeps_an_environment_that_is_no_longer_used():
    env = SafetyGymEnv("PointGoal2", num_envs=2, seed=0, num_threads=1)
    env.rollout(2)
    physics = weakref.ref(env._physics)
    del env
    gc.collect()
    assert physics() is None
