"""Gymnasium's vector interface: its own vector environment as a reference."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv

SHORT = {"num_steps": 3}
MODES = list(AutoresetMode)


def run(envs, mode, num_steps):
    """Everything that reset and steps return, resetting by hand where that is the mode."""
    outcomes = [envs.reset(seed=7)]
    generator = np.random.default_rng(0)
    for _ in range(num_steps):
        actions = generator.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        outcomes.append(envs.step(actions))
        ended = outcomes[-1][2] | outcomes[-1][3]
        if mode is AutoresetMode.DISABLED and ended.any():
            outcomes.append(envs.reset(options={"reset_mask": ended}))
    return outcomes


@pytest.mark.parametrize("flatten", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_a_batch_of_one_is_gymnasiums_vector_of_one(mode, flatten):
    config = {**SHORT, "observation_flatten": flatten}
    make = {"id": "Safexp-CarGoal2-v0", "config": config, "positions": flatten}
    ours = gymnasium.make_vec(**make, num_envs=1, autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: gymnasium.make(**make)], autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    for got, expected in zip(run(ours, mode, 8), run(theirs, mode, 8), strict=True):
        assert data_equivalence(got[:-1], expected[:-1], exact=True)
        # Where no world reports a key, Gymnasium leaves it out and a batch has it masked.
        reported = {key: got[-1][key] for key in expected[-1]}
        assert data_equivalence(reported, expected[-1], exact=True)
        for key in set(got[-1]) - set(reported):
            assert not got[-1][f"_{key.removeprefix('_')}"].any()


@pytest.mark.parametrize("mode", MODES)
def test_rows_of_a_batch_end_apart(mode):
    """Goals that end episodes make them end at different times; every row continues as if alone."""
    config = {"continue_goal": False, "goal_size": 0.9, "num_steps": 30}
    make = {"id": "Safexp-PointGoal0-v0", "config": config, "autoreset_mode": mode}
    batch = gymnasium.make_vec(**make, num_envs=5)
    assert batch.num_envs == 5
    outcomes = run(batch, mode, 40)
    steps = [outcome for outcome in outcomes if len(outcome) == 5]
    ends = np.array([step[2] | step[3] for step in steps])
    assert len({tuple(row) for row in ends.T.tolist()}) > 2
    if mode is AutoresetMode.NEXT_STEP:
        begins = np.roll(ends, 1, axis=0)
        begins[0] = False
        reported = np.array([step[-1]["_cost"] for step in steps])
        np.testing.assert_array_equal(reported, ~begins)
        assert not np.array([step[1] for step in steps])[begins].any()
        assert not ends[begins].any()
    if mode is AutoresetMode.SAME_STEP:
        for step, ended in zip(steps, ends, strict=True):
            assert ended.any() == ("final_obs" in step[-1])
            if ended.any():
                np.testing.assert_array_equal(step[-1]["_final_obs"], ended)
                finals = step[-1]["final_obs"]
                assert [final is not None for final in finals] == ended.tolist()
                row = int(np.argmax(ended))
                assert (finals[row] != step[0][row]).any()
    if mode is AutoresetMode.DISABLED:
        resets = [outcome for outcome in outcomes[1:] if len(outcome) == 2]
        assert len(resets) == ends.any(1).sum()


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


@pytest.mark.parametrize("keys", [{}, {"randomize_layout": False}])
def test_every_world_may_have_a_seed_of_its_own(keys):
    make = {"id": "Safexp-PointGoal2-v0", "config": {**SHORT, **keys}}
    seeds = [3, 11, 3]
    envs, batch = gymnasium.make_vec(**make, num_envs=3), envs_of(make, 3)
    first, _ = envs.reset(seed=seeds)
    np.testing.assert_array_equal(first, batch.reset(seed=seeds)[0])
    np.testing.assert_array_equal(first[0], first[2])
    assert (first[0] != first[1]).any()
    actions = np.zeros((3, 2), np.float32)
    for _ in range(6):  # into the next episodes
        np.testing.assert_array_equal(envs.step(actions)[0], batch.step(actions)[0])
    again, _ = envs.reset(seed=[None, 11, None])
    np.testing.assert_array_equal(again[1], first[1])
    if not keys:
        assert (again[0] != first[0]).any()
    with pytest.raises(ValueError, match="3 worlds need as many seeds, got 2"):
        envs.reset(seed=[1, 2])
    as_array, _ = envs.reset(seed=np.array([3, 11, 2]))
    np.testing.assert_array_equal(as_array, envs.reset(seed=[3, 11, 2])[0])
    for wrong in (2.5, "3"):
        with pytest.raises(TypeError, match="A seed is an integer, or one for every world"):
            envs.reset(seed=wrong)


def envs_of(make, num_envs):
    """Single worlds, as Gymnasium itself puts them together."""
    return SyncVectorEnv([lambda: gymnasium.make(**make)] * num_envs)


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
