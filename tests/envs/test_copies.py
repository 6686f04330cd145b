"""Copies of an environment continue as it does, and on their own."""

import copy
import gc
import pickle
import weakref

import gymnasium
import numpy as np
import pytest
from playing import assert_same, play

from safe_rl.envs import SUITE, SafetyGymEnv
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv

# Short episodes, so that resets are among the compared steps.
BUSY = {"num_steps": 15}
SAFETY_GYM = {
    "PointGoal2": {"goal_size": 0.9},
    "CarButton2": {"buttons_size": 0.2},
    "DoggoPush1": {"action_noise": 0.3, "frameskip_binom_p": 0.7},
    "PointPush1": {"randomize_layout": False},
    "CarGoal1": {"observation_flatten": False, "layout_seeds": 3},
}
COPY = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


def safety_gym(name, **changes):
    config = SUITE[name].replace(**BUSY, **SAFETY_GYM[name])
    return SafetyGymEnv(config, **{"num_envs": 3, "seed": 5, "num_threads": 1, **changes})


def velocity(name):
    return VelocityEnv(VELOCITY_SUITE[name].replace(**BUSY), num_envs=3, seed=5, num_threads=1)


MAKERS = {name: lambda name=name: safety_gym(name, sleep=False) for name in SAFETY_GYM}
MAKERS |= {name: lambda name=name: velocity(name) for name in VELOCITY_SUITE}


@pytest.mark.parametrize("how", COPY)
@pytest.mark.parametrize("name", MAKERS)
def test_a_copy_continues_as_the_original_does(name, how):
    env = MAKERS[name]()
    play(env, env.reset(), 10)
    here = env.set_state(env.get_state())
    other = COPY[how](env)
    assert type(other) is type(env)
    assert (other.config, other.batch_size, other.device) == (
        *(env.config, env.batch_size, env.device),
    )
    # The original goes first: what it does must not reach the copy.
    expected, got = play(env, here.clone(), 40), play(other, here.clone(), 40)
    assert_same(expected, got)
    assert expected["truncated"].any()


@pytest.mark.parametrize("name", ["PointPush1", "CarButton2", "SafeHopperVelocity"])
def test_copies_before_the_first_reset_begin_the_same_episodes(name):
    env = MAKERS[name]()
    other = copy.deepcopy(env)
    with pytest.raises(RuntimeError, match="No episode has begun"):
        other.step(other.rand_action())
    assert_same(env.reset(), other.reset())
    assert_same(env.reset(), other.reset())


@pytest.mark.parametrize("how", COPY)
def test_copies_in_gymnasium(how):
    make = {"id": "Safexp-PointGoal2-v0", "config": {"num_steps": 15}, "sleep": False}
    for env in (gymnasium.make(**make), gymnasium.make_vec(**make, num_envs=2)):
        env.reset(seed=1)
        actions = np.random.default_rng(0).uniform(-1, 1, (30, *env.action_space.shape))
        actions = actions.astype(np.float32)
        for action in actions[:7]:
            env.step(action)
        other = COPY[how](env)
        for action in actions[7:14]:
            # each of them in turn
            expected, got = env.step(action), other.step(action)
            np.testing.assert_array_equal(expected[0], got[0])
            np.testing.assert_array_equal(expected[1], got[1])


def test_nothing_keeps_an_environment_that_is_no_longer_used():
    env = safety_gym("PointGoal2")
    env.rollout(2)
    physics = weakref.ref(env._physics)
    del env
    gc.collect()
    assert physics() is None
