"""The velocity family under Gymnasium's ids."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from safe_rl.envs import ConfigError, make_env
from safe_rl.envs.velocity import VELOCITY_SUITE


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_ids_make_what_gymnasium_checks(name):
    env = gymnasium.make(f"safe_rl.envs:{name}-v0")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.spec.max_episode_steps == 1000
    theirs = gymnasium.make(env.unwrapped.batch._robot.gymnasium_id)
    assert env.metadata["render_fps"] == theirs.unwrapped.metadata["render_fps"]
    assert env.observation_space.shape == theirs.observation_space.shape
    assert np.array_equal(env.action_space.low, theirs.action_space.low)
    assert np.array_equal(env.action_space.high, theirs.action_space.high)


def test_episodes_are_those_of_the_batched_environment():
    single = gymnasium.make("SafeHopperVelocity-v0", config={"velocity_threshold": 0.1})
    node = {"_target_": "safe_rl.envs.velocity.VelocityEnv", "robot": "hopper"}
    batch = make_env({**node, "velocity_threshold": 0.1}, num_envs=1, seed=5)
    observation, _ = single.reset(seed=5)
    state, costs, ends = batch.reset(), [], 0
    generator = np.random.default_rng(0)
    for _ in range(60):
        assert np.array_equal(observation, state["observation"][0].numpy())
        action = generator.uniform(-1, 1, 3).astype(np.float32)
        observation, reward, terminated, truncated, info = single.step(action)
        action = torch.from_numpy(action)[None]
        step, state = batch.step_and_maybe_reset(state.set("action", action))
        step = step["next"]
        assert (reward, terminated) == (step["reward"].item(), step["terminated"].item())
        assert info["cost_velocity"] == step["cost"].item()
        costs.append(info["cost"])
        if terminated or truncated:
            observation, _ = single.reset()
            ends += 1
    assert ends > 0
    assert 0 < np.mean(costs) < 1


def test_wrong_arguments_are_refused():
    with pytest.raises(ConfigError, match="Did you mean 'velocity_threshold'"):
        gymnasium.make("SafeHopperVelocity-v0", config={"velocity_treshold": 1.0})
    with pytest.raises(ValueError, match="render_mode must be one of"):
        gymnasium.make("SafeHopperVelocity-v0", render_mode="ansi", disable_env_checker=True)


def test_a_batch_in_gymnasiums_vector_interface():
    envs = gymnasium.make_vec("SafeHopperVelocity-v0", num_envs=3, config={"num_steps": 5})
    single = gymnasium.make("SafeHopperVelocity-v0", config={"num_steps": 5})
    observation, _ = envs.reset(seed=[7, 4, 7])
    assert np.array_equal(observation[1], single.reset(seed=4)[0])
    assert np.array_equal(observation[0], observation[2])
    for _ in range(5):
        *_, truncated, infos = envs.step(np.zeros((3, 3), np.float32))
    assert truncated.all()
    assert infos["cost_velocity"].shape == (3,)
