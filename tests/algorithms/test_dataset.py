"""Datasets mean the same in every family: a clone does in the raw environment what they say."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium_envs import make_pendulum

import safe_rl
from safe_rl.algorithms import OffPolicy
from safe_rl.collectors import Recording, describe_env, read_action_bounds, read_recording
from safe_rl.envs import make_env

h5py = pytest.importorskip("h5py", reason="comes with the extra hdf5")


class Battery(gymnasium.Env):
    """Current from 0 to 2 earns itself, and costs 1 when it is above 1."""

    action_space = gymnasium.spaces.Box(0.0, 2.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.ones(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        cost = float(action[0] > 1)
        return np.ones(1, np.float32), float(action[0]), False, False, {"cost": cost}


gymnasium.register("Battery-v0", entry_point=f"{__name__}:Battery", max_episode_steps=10)
gymnasium.register("Swing-v0", entry_point=make_pendulum)

GYMNASIUM = {"env": "gymnasium", "env.id": "Battery-v0"}
FAMILIES = {
    "bounds [0, 2]": ("Battery-v0", GYMNASIUM, 0.5),
    "pendulum": ("Swing-v0", {"env": "gymnasium", "env.id": "Swing-v0", "env.num_steps": 200}, 1.4),
    "velocity": ("SafeHumanoidVelocity-v0", {"env": "SafeHumanoidVelocity"}, 0.3),
    "safety gym": ("Safexp-PointGoal1-v0", {"env": "PointGoal1", "env.num_steps": 200}, 0.6),
}


def write_episodes(path, name, action, episodes=12, steps=200):
    """An HDF5 file of constant actions in an environment's own units; returns all returns."""
    env, columns, returns = gymnasium.make(name), {}, np.zeros(episodes)
    action = np.full(env.action_space.shape, action, np.float32)
    for episode in range(episodes):
        before, _ = env.reset(seed=episode)
        for step in range(1, steps + 1):
            after, reward, terminated, truncated, info = env.step(action)
            cost = info.get("cost", info.get("cost_speed"))
            row = {"observations": before, "next_observations": after, "actions": action,
                   "rewards": reward, "costs": cost, "terminals": terminated,
                   "timeouts": truncated or (step == steps and not terminated)}  # fmt: skip
            for key, value in row.items():
                columns.setdefault(key, []).append(value)
            before, returns[episode] = after, returns[episode] + reward
            if row["terminals"] or row["timeouts"]:
                break
    with h5py.File(path, "w") as file:
        for key, values in columns.items():
            file[key] = np.array(values)
    return returns


def clone(folder, data, settings, **others):
    small = {"frames": 1600, "frames_per_batch": 400, "num_envs": 4, "logger": "none"}
    network = {"model.hidden_sizes": [16], "memory.batch_size": 32, "cost_limits": {"cost": 1e6}}
    return safe_rl.train(
        algo="bc", directory=folder, **small, **network, **settings, **others,
        **{"dataset.path": str(data)},
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("family", FAMILIES)
def test_a_clone_does_in_the_raw_environment_what_the_file_says(family, tmp_path):
    name, settings, action = FAMILIES[family]
    returns = write_episodes(tmp_path / "data.hdf5", name, action)
    run = clone(tmp_path / "run", tmp_path / "data.hdf5", settings)
    found = run.evaluate(episodes=12, record=True)
    tolerance = 0.02 * abs(returns.mean()) + 3 * returns.std() * (2 / 12) ** 0.5
    assert abs(found.estimates["episode_return"].value - returns.mean()) <= tolerance
    steps = read_recording(run.directory / "evaluation.transitions")
    bounds = read_action_bounds(run.directory / "evaluation.transitions")
    low, high, own_low, own_high = bounds
    own = own_low + (steps["action"].clamp(low, high) - low) / (high - low) * (own_high - own_low)
    assert own.median().item() == pytest.approx(action, abs=0.05)


def learned_actions(path, env):
    """Actions in the replay buffer of a clone, in order of the columns of the path's steps."""
    from run_configs import compose_config

    config = compose_config(
        *("algo=bc", "env=gymnasium", "env.id=Battery-v0", f"dataset.path={path}"),
        *("model.hidden_sizes=[8]", "memory.batch_size=4", "cost_limits={cost: 1e6}"),
    )
    buffer = OffPolicy.build(config, env).replay_buffer
    return torch.cat([batch["action"] for batch in buffer.minibatches(20)]).unique().tolist()


@pytest.mark.parametrize(
    ("action", "told"),
    [
        (1.0, None),
        (2.000001, None),
        (50.0, r"100\.0% of its actions.*from 50 to 50, and the bounds are 0 and 2"),
        (-0.5, "from -0.5 to -0.5, and the bounds are 0 and 2"),
    ],
)
def test_actions_of_a_file_are_in_the_environment_s_units(action, told, tmp_path):
    write_episodes(tmp_path / "data.hdf5", "Battery-v0", 1.0)
    with h5py.File(tmp_path / "data.hdf5", "a") as file:
        file["actions"][...] = action
    env = make_env(
        {"_target_": "safe_rl.envs.gymnasium.make_gymnasium", "id": "Battery-v0"}, num_envs=2
    )
    if told is None:
        assert learned_actions(tmp_path / "data.hdf5", env) == [round(action - 1, 3)]
        return
    with pytest.raises(ValueError, match=told):
        learned_actions(tmp_path / "data.hdf5", env)


def test_recorded_actions_are_those_of_the_policy(tmp_path):
    """A policy drew actions beyond its bounds, and the environment clipped them."""
    env = make_env(
        {"_target_": "safe_rl.envs.gymnasium.make_gymnasium", "id": "Battery-v0"}, num_envs=2
    )
    steps = env.rollout(10)
    steps["action"].fill_(-1.5)
    Recording(tmp_path / "known", env.cost_keys, describe_env(env)).write(0, steps)
    assert learned_actions(tmp_path / "known", env) == [-1.0]
    steps["action"].fill_(0.25)  # of an environment whose policies act in its own units
    about = {"actions": {"low": [0.0], "high": [2.0], "own_low": [0.0], "own_high": [2.0]}}
    Recording(tmp_path / "other", env.cost_keys, about).write(0, steps)
    assert learned_actions(tmp_path / "other", env) == [-0.75]
