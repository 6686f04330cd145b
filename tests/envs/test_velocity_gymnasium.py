"""The velocity family under Gymnasium's ids."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

from safe_rl.collectors import make_process_collector
from safe_rl.envs import ConfigError, make_env
from safe_rl.envs.velocity import VELOCITY_SUITE
from safe_rl.models import BehaviourPolicy, make_actor


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


def test_processes_collect_it():
    """Rows go on from the states that one process would have begun with."""
    env = make_env("SafeHopperVelocity", num_envs=4, seed=0)
    size = env.observation_spec["observation"].shape[-1]
    policy = BehaviourPolicy(make_actor(size, 3, hidden_sizes=[8], initial_log_std=-0.5))

    def make(*, num_envs):
        return make_env("SafeHopperVelocity", num_envs=num_envs, seed=0)

    expected = make(num_envs=4)
    expected.reset()  # the collector's first reset follows the one that the rows are shared out at
    expected = expected.reset()["observation"]
    collector = make_process_collector(
        env, make, policy, frames_per_batch=40, num_collectors=2, device="cpu"
    )
    try:
        batch = next(iter(collector))
    finally:
        collector.shutdown()
    assert batch.shape == (4, 10)
    torch.testing.assert_close(batch["observation"][:, 0], expected)
    step = TensorDict({"action": batch["action"][:, 0]}, [4])
    assert step["action"].std() > 0.1
