"""Keys, observation, reward and termination are Gymnasium's, costs are Safety-Gymnasium's."""

import inspect
import math

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from scipy.stats import ks_2samp, kstest, uniform
from tensordict import TensorDict

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.physics.dynamics import SCALES
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv, resolve_velocity
from safe_rl.envs.velocity.velocity_config import RUNNERS

# Names, Gymnasium's ids, and the thresholds that Safety-Gymnasium 1.0 publishes.
FAMILY = {
    "SafeHalfCheetahVelocity": ("HalfCheetah-v5", 3.2096),
    "SafeHopperVelocity": ("Hopper-v5", 0.7402),
    "SafeWalker2dVelocity": ("Walker2d-v5", 2.3415),
    "SafeAntVelocity": ("Ant-v5", 2.6222),
    "SafeSwimmerVelocity": ("Swimmer-v5", 0.2282),
    "SafeHumanoidVelocity": ("Humanoid-v5", 1.4149),
}
IN_THE_PLANE = ("SafeAntVelocity", "SafeHumanoidVelocity")
NEVER_FALL = ("SafeHalfCheetahVelocity", "SafeSwimmerVelocity")
WITHOUT_POSITIONS = {"exclude_current_positions_from_observation": False}
OTHER_KEYS = [
    ("SafeHalfCheetahVelocity", {"frame_skip": 2, "ctrl_cost_weight": 3.0, **WITHOUT_POSITIONS}),
    ("SafeHopperVelocity", {"healthy_angle_range": (-0.05, 0.3), "healthy_reward": 2.0}),
    ("SafeHopperVelocity", {"healthy_state_range": (-1.0, 1.0), "healthy_z_range": (1.2, 1.4)}),
    ("SafeHopperVelocity", {"terminate_when_unhealthy": False, **WITHOUT_POSITIONS}),
    ("SafeWalker2dVelocity", {"forward_reward_weight": 3.0, "healthy_z_range": (1.2, 1.3)}),
    ("SafeAntVelocity", {"include_cfrc_ext_in_observation": False, **WITHOUT_POSITIONS}),
    ("SafeAntVelocity", {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}),
    ("SafeAntVelocity", {"contact_force_range": (-30.0, 10.0), "frame_skip": 1}),
    ("SafeSwimmerVelocity", {"ctrl_cost_weight": 1.0, **WITHOUT_POSITIONS}),
    ("SafeHumanoidVelocity", {"contact_cost_weight": 0.1, "contact_cost_range": (1.0, 50.0)}),
    ("SafeHumanoidVelocity", {"include_cvel_in_observation": False, **WITHOUT_POSITIONS}),
    ("SafeHumanoidVelocity", {"include_cinert_in_observation": False, "healthy_reward": 1.0}),
]
CASES = [(name, {}) for name in FAMILY] + OTHER_KEYS
NUM_ENVS = 24


def make_both(name, keys, num_envs=NUM_ENVS):
    """This environment with observations before they are cast, and Gymnasium's."""
    config = resolve_velocity(name).replace(**keys)
    env = VelocityEnv(config, num_envs=num_envs, seed=0, num_threads=1)
    env._observation = env._observation.double()
    return env, gymnasium.make(FAMILY[name][0], disable_env_checker=True, **keys).unwrapped


def random_states(env, name):
    """Robots in the air and on the ground, upright and not, fast and slow."""
    env.reset()
    state = env.get_state().exclude("place", "observation")
    draw = np.random.default_rng(0)
    height = {"SafeHopperVelocity": 1, "SafeWalker2dVelocity": 1}.get(name, 2)
    if name not in NEVER_FALL:
        state["qpos"][:, height] += torch.from_numpy(draw.uniform(-0.55, 0.55, NUM_ENVS))
        state["qpos"][:, 3 - height] += torch.from_numpy(draw.normal(scale=0.2, size=NUM_ENVS))
    state["qvel"] += torch.from_numpy(draw.normal(scale=3.0, size=state["qvel"].shape))
    state["qvel"][:, 0] += 4.0
    state["qvel"] *= torch.linspace(0.0, 1.0, NUM_ENVS)[:, None]
    return state


def random_actions(env):
    low, high = env._control_range
    return low + (high - low) * torch.rand(NUM_ENVS, len(low), dtype=torch.float64)


def same_start(other, state, row):
    """Put one of the states into Gymnasium's environment, as its own reset does."""
    mujoco.mj_resetData(other.model, other.data)
    other.set_state(state["qpos"][row].numpy(), state["qvel"][row].numpy())


def close(ours, theirs):
    return np.allclose(ours.numpy(), theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("name", "keys"), CASES)
def test_one_step_from_random_states(name, keys):
    env, other = make_both(name, keys)
    state, actions = random_states(env, name), random_actions(env)
    start = env.set_state(state)["observation"]
    reward, terminated = env._move(actions)
    env.set_state(state)
    written = env._step(TensorDict({"action": actions}, [NUM_ENVS]))
    cost = written["cost"][:, 0].tolist()
    for row in range(NUM_ENVS):
        same_start(other, state, row)
        assert close(start[row], other._get_obs())
        observation, gained, ended, _, info = other.step(actions[row].numpy())
        assert close(written["observation"][row], observation)
        assert close(reward[row], gained)
        assert bool(terminated[row]) == ended == bool(written["terminated"][row])
        assert written["reward"][row].item() == pytest.approx(gained, rel=1e-6, abs=1e-5)
        speed = info["x_velocity"]
        if name in IN_THE_PLANE:
            speed = np.sqrt(info["x_velocity"] ** 2 + info["y_velocity"] ** 2)
        assert cost[row] == float(speed > FAMILY[name][1])
    assert set(cost) == {0.0, 1.0}
    if name not in NEVER_FALL and keys.get("terminate_when_unhealthy", True):
        assert terminated.any()
        assert not terminated.all()


@pytest.mark.parametrize("name", FAMILY)
def test_episodes_from_their_start(name):
    """Velocities are displacements since the step before, and solvers start where they ended."""
    env, other = make_both(name, {})
    env.reset()
    state = env.get_state()
    plan = [random_actions(env) for _ in range(10)]
    ours = []
    for actions in plan:
        reward, _ = env._move(actions)
        env._observer.write(env._physics, env._observation)
        ours.append((env._observation.clone(), reward))
    for row in range(4):
        same_start(other, state, row)
        for actions, (observation, reward) in zip(plan, ours, strict=True):
            theirs, gained, *_ = other.step(actions[row].numpy())
            assert np.allclose(observation[row].numpy(), theirs, rtol=1e-6, atol=1e-6)
            assert reward[row].item() == pytest.approx(gained, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("name", FAMILY)
def test_starts_are_distributed_as_gymnasiums(name):
    env, other = make_both(name, {}, num_envs=1000)
    env.reset()
    ours = torch.cat([env.get_state()["qpos"], env.get_state()["qvel"]], -1).numpy()
    theirs = []
    for seed in range(300):
        other.reset(seed=seed)
        theirs.append(np.concatenate([other.data.qpos, other.data.qvel]))
    for mine, its in zip(ours.T, np.stack(theirs).T, strict=True):
        assert ks_2samp(mine, its).pvalue > 1e-4
        assert abs(mine.std() / its.std() - 1) < 0.15
    assert abs(np.corrcoef(ours.T) - np.eye(ours.shape[1])).max() < 0.2
    # all positions at once, because single columns do not show a scale that is a tenth smaller
    noise = ours[:, : len(other.init_qpos)] - other.init_qpos
    scale = resolve_velocity(name).reset_noise_scale
    assert kstest(noise.ravel() / scale, uniform(-1, 2).cdf).pvalue > 1e-3


OURS = {"robot", "velocity_threshold", "num_steps", "physics", "physics_buffers", *SCALES}
THEIRS = {"xml_file", "default_camera_config", "main_body", "kwargs", "self"}


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_keys_and_defaults_are_gymnasiums(name):
    config = resolve_velocity(name)
    made = gymnasium.make(RUNNERS[config.robot].gymnasium_id).unwrapped
    parameters = inspect.signature(type(made).__init__).parameters
    defaults = {key: row.default for key, row in parameters.items() if key not in THEIRS}
    ours = {key: value for key, value in config.to_dict().items() if key not in OURS}
    assert ours == defaults


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("SafeHoperVelocity", "Did you mean 'SafeHopperVelocity'"),
        ({"frame_skip": 2}, "'robot' must be one of"),
        ({"robot": "hoper"}, "Did you mean 'hopper'"),
        ({"robot": "hopper", "velocity_treshold": 1.0}, "Did you mean 'velocity_threshold'"),
        ({"robot": "swimmer", "healthy_reward": 1.0}, "'swimmer' has no key"),
        ({"robot": "hopper", "frame_skip": 0}, "frame_skip=0: it must be greater"),
        ({"robot": "hopper", "healthy_reward": math.inf}, "must be a finite number"),
        ({"robot": "hopper", "healthy_z_range": [2.0, 1.0]}, "lowest <= highest"),
    ],
)
def test_mistakes_are_named(given, message):
    with pytest.raises(ConfigError, match=message):
        resolve_velocity(given)
