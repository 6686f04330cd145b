"""Gymnasium's vector interface: its own vector environment as a reference."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import safe_rl.envs  # noqa: F401, registers the environments

SHORT = {"num_steps": 3}


def run(envs, mode, num_steps):
    """Everything that reset and steps return, resetting by hand where that is the mode."""
    outcomes = [envs.reset(seed=[3, 11, 5])]
    generator = np.random.default_rng(0)
    for _ in range(num_steps):
        actions = generator.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        outcomes.append(envs.step(actions))
        ended = outcomes[-1][2] | outcomes[-1][3]
        if mode is AutoresetMode.DISABLED and ended.any():
            outcomes.append(envs.reset(options={"reset_mask": ended}))
    return outcomes


@pytest.mark.parametrize("flatten", [True, False])
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_batch_is_gymnasiums_vector_of_single_worlds(mode, flatten):
    """Rows begin and end apart, because met goals end episodes, and have seeds of their own."""
    config = {"continue_goal": False, "goal_size": 0.9, "num_steps": 30}
    config |= {"observation_flatten": flatten, "randomize_layout": flatten}
    make = {"id": "Safexp-PointGoal0-v0", "config": config, "positions": flatten}
    ours = gymnasium.make_vec(**make, num_envs=3, autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: gymnasium.make(**make)] * 3, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    outcomes = run(ours, mode, 40)
    for got, expected in zip(outcomes, run(theirs, mode, 40), strict=True):
        assert data_equivalence(got[:-1], expected[:-1], exact=True)
        # Where no world reports a key, Gymnasium leaves it out and a batch has it masked.
        reported = {key: got[-1][key] for key in expected[-1]}
        assert data_equivalence(reported, expected[-1], exact=True)
        for key in set(got[-1]) - set(reported):
            assert not got[-1][f"_{key.removeprefix('_')}"].any()
    ends = np.array([step[2] | step[3] for step in outcomes if len(step) == 5])
    assert len({tuple(row) for row in ends.T.tolist()}) > 1


def test_a_batch_that_is_not_reset_says_so():
    envs = gymnasium.make_vec(
        "Safexp-PointGoal1-v0", num_envs=2, config=SHORT, autoreset_mode="Disabled"
    )
    envs.reset(seed=0)
    actions = np.zeros((2, 2), np.float32)
    for _ in range(3):
        envs.step(actions)
    with pytest.raises(RuntimeError, match=r"Worlds \[0, 1\] have ended.*reset_mask"):
        envs.step(actions)
    with pytest.raises(ValueError, match="boolean array of shape"):
        envs.reset(options={"reset_mask": np.array([True])})
    with pytest.raises(ValueError, match="A seed is for all worlds"):
        envs.reset(seed=1, options={"reset_mask": np.array([True, False])})
    envs.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(RuntimeError, match=r"Worlds \[1\] have ended"):
        envs.step(actions)


def test_some_worlds_may_get_a_seed_of_their_own():
    envs = gymnasium.make_vec("Safexp-PointGoal2-v0", num_envs=3, config=SHORT)
    first, _ = envs.reset(seed=np.array([3, 11, 3]))
    np.testing.assert_array_equal(first[0], first[2])
    again, _ = envs.reset(seed=[None, 11, None])
    np.testing.assert_array_equal(again[1], first[1])
    assert (again[0] != first[0]).any()
    with pytest.raises(ValueError, match="3 worlds need as many seeds, got 2"):
        envs.reset(seed=[1, 2])
    for wrong in (2.5, "3"):
        with pytest.raises(TypeError, match="A seed is an integer, or one for every world"):
            envs.reset(seed=wrong)


@pytest.mark.parametrize("flatten", [True, False])
def test_bounds_are_true(flatten):
    config = {
        **{"observation_flatten": flatten, "observe_goal_comp": True, "observe_goal_dist": True},
        **{"observe_remaining": True, "compass_shape": 3},
    }
    envs = gymnasium.make_vec("Safexp-CarGoal2-v0", num_envs=20, config=config)
    bounds = {"goal_compass": (-1, 1), "goal_dist": (0, 1)}
    bounds |= {f"{kind}_lidar": (0, 1) for kind in ("goal", "hazards", "vases")}
    env, space = envs.batch, envs.single_observation_space
    observation, _ = envs.reset(seed=0)
    for name, columns in env.observation_layout.items():
        box = space if flatten else space[name]
        rows = columns if flatten else slice(None)
        low, high = bounds.get(name, (-np.inf, np.inf))
        assert (box.low[rows] == low).all(), name
        assert (box.high[rows] == high).all(), name
    for _ in range(50):
        assert observation in envs.observation_space
        observation, *_ = envs.step(envs.action_space.sample())
