"""Gymnasium's interfaces, against its checkers and vectors, and against the batched environment."""

import warnings

import gymnasium
import gymnasium_loop
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from pictures import MISSING_OPENGL, needs_opengl
from torchrl.envs import GymEnv

from safe_rl.envs import EXTRAS, SUITE, ConfigError, env_node, make_env
from safe_rl.envs.velocity import VELOCITY_SUITE

IDS = [f"Safexp-{name}-v0" for name in (*SUITE, *EXTRAS)]
SHORT = {"num_steps": 3}


def test_every_name_is_registered():
    registered = {env_id for env_id in gymnasium.registry if env_id.startswith("Safexp-")}
    assert registered == {*IDS, "Safexp-Custom-v0"}
    assert gymnasium.make("safe_rl.envs:Safexp-PointGoal0-v0").observation_space.shape == (28,)


@pytest.mark.parametrize(
    "env_id",
    [
        *("Safexp-PointGoal1-v0", "Safexp-Custom-v0"),
        pytest.param("Safexp-CarPush1Vision-v0", marks=needs_opengl),
    ],
)
def test_gymnasiums_checker_has_nothing_to_say(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Sensors feel accelerations of any size: their bounds are infinite.
        warnings.filterwarnings("ignore", message=".*A Box observation space .* is -?infinity")
        env = gymnasium.make(env_id).unwrapped
        check_env(env, skip_render_check=bool(MISSING_OPENGL))


@pytest.mark.parametrize(
    ("env_id", "name", "keys"),
    [
        ("Safexp-CarGoal2-v0", "CarGoal2", {"num_steps": 150}),
        ("SafeHopperVelocity-v0", "SafeHopperVelocity", {"velocity_threshold": 0.1}),
    ],
)
def test_steps_are_those_of_the_batched_environment(env_id, name, keys):
    single = gymnasium.make(env_id, config=keys)
    batch = make_env({**env_node(name), **keys}, seed=11)
    observation, _ = single.reset(seed=11)
    tensordict, generator = batch.reset(), np.random.default_rng(0)
    costs, first = [], 0
    for _ in range(200):
        np.testing.assert_array_equal(observation, tensordict["observation"][0])
        action = generator.uniform(0.4, 1, single.action_space.shape).astype(np.float32)
        observation, reward, terminated, truncated, info = single.step(action)
        tensordict["action"] = torch.from_numpy(action)[None]
        step, tensordict = batch.step_and_maybe_reset(tensordict)
        step = step["next"]
        assert (reward, terminated) == (step["reward"].item(), step["terminated"].item())
        assert truncated == step["truncated"].item()
        total = info.pop("episode_cost")
        assert set(info) == {*batch.cost_keys, "goal_met"} & set(step.keys())
        assert {key: step[key].item() for key in info} == info
        costs.append(info["cost"])
        assert total == sum(costs[first:])
        if terminated or truncated:
            first = len(costs)
            observation, _ = single.reset()
    assert first > 0
    assert 0 < np.mean(costs) < 1


def test_any_configuration_can_be_made():
    config = {"robot_base": "point", "hazards_num": 2, "constrain_hazards": True}
    env = gymnasium.make("Safexp-Custom-v0", config=config)
    # what records whole episodes, as Minari does, needs the same keys in both
    assert env.reset(seed=0)[1] == dict.fromkeys(env.step(env.action_space.sample())[-1], 0)
    changed = gymnasium.make("Safexp-PointGoal1-v0", config={"lidar_num_bins": 8})
    assert changed.observation_space.shape == (12 + 3 * 8,)
    short = gymnasium.make("SafeHopperVelocity-v0", config={"num_steps": 7})
    assert short.spec.max_episode_steps == 7
    for told, name, given in (
        ("Did you mean 'hazards_num'", "Safexp-Custom", {"config": {"hazard_num": 2}}),
        ("mean 'velocity_threshold'", "SafeHopperVelocity", {"config": {"velocity_treshold": 1}}),
        (r"config=\{'hazards_num': …\}", "Safexp-PointGoal1", {"hazards_num": 3}),
        ("render_mode must be one of", "SafeHopperVelocity", {"render_mode": "ansi"}),
    ):
        with pytest.raises((ConfigError, TypeError, ValueError), match=told):
            gymnasium.make(f"{name}-v0", disable_env_checker=True, **given)


def test_specs_say_how_long_episodes_are_and_time_is_up_once():
    config = {"num_steps": 1200, "frameskip_binom_n": 1}
    make = {"id": "Safexp-PointGoal1-v0", "config": config}
    env, envs = gymnasium.make(**make), gymnasium.make_vec(**make, num_envs=2)
    env.reset(seed=0)
    ends = [any(env.step(np.zeros(2, np.float32))[2:4]) for _ in range(1200)]
    assert ends == [False] * 1199 + [True]
    for made in (env, envs, gymnasium.make(env.spec), gymnasium.make_vec(envs.spec)):
        assert made.spec.max_episode_steps == 1200
    short = gymnasium.make_vec(**make, num_envs=2, max_episode_steps=3)
    short.reset(seed=0)
    ends = [short.step(np.zeros((2, 2), np.float32))[3].all() for _ in range(3)]
    assert ends == [False, False, True]


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_ids_of_the_velocity_family_make_what_gymnasium_checks(name):
    env = gymnasium.make(f"safe_rl.envs:{name}-v0")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.spec.max_episode_steps == 1000
    theirs = gymnasium.make(f"{name.removeprefix('Safe').removesuffix('Velocity')}-v5")
    assert env.metadata["render_fps"] == theirs.unwrapped.metadata["render_fps"]
    assert env.observation_space.shape == theirs.observation_space.shape
    assert np.array_equal(env.action_space.low, theirs.action_space.low)
    assert np.array_equal(env.action_space.high, theirs.action_space.high)


def run(envs, num_steps):
    """Everything that reset and steps return."""
    outcomes = [envs.reset(seed=[3, 11, 5])]
    generator = np.random.default_rng(0)
    for _ in range(num_steps):
        actions = generator.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        outcomes.append(envs.step(actions))
    return outcomes


@pytest.mark.parametrize(
    ("mode", "flatten"),
    [(AutoresetMode.SAME_STEP, True), *((AutoresetMode.NEXT_STEP, flat) for flat in (True, False))],
)
def test_a_batch_is_gymnasiums_vector_of_single_worlds(mode, flatten):
    """Rows begin and end apart, because met goals end episodes, and have seeds of their own."""
    config = {"continue_goal": False, "goal_size": 0.9, "num_steps": 30}
    config |= {"observation_flatten": flatten, "randomize_layout": flatten}
    make = {"id": "Safexp-PointGoal0-v0", "config": config}
    ours = gymnasium.make_vec(**make, num_envs=3, autoreset_mode=mode)
    theirs = SyncVectorEnv([lambda: gymnasium.make(**make)] * 3, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    outcomes = run(ours, 40)
    for got, expected in zip(outcomes, run(theirs, 40), strict=True):
        assert data_equivalence(got, expected, exact=True)
    ends = np.array([step[2] | step[3] for step in outcomes if len(step) == 5])
    assert len({tuple(row) for row in ends.T.tolist()}) > 1


def test_a_batch_resets_rows_itself():
    with pytest.raises(ValueError, match="NextStep or SameStep"):
        gymnasium.make_vec("Safexp-PointGoal1-v0", num_envs=2, autoreset_mode="Disabled")
    envs = gymnasium.make_vec("Safexp-PointGoal1-v0", num_envs=2, config=SHORT)
    with pytest.raises(ValueError, match="no 'reset_mask'"):
        envs.reset(options={"reset_mask": np.array([True, False])})


def test_actions_of_another_number_of_environments_are_refused_by_their_number():
    envs = gymnasium.make_vec("Safexp-PointGoal1-v0", num_envs=2)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"There are 2 environments.*\(3, 2\): give one row for e"):
        envs.step(np.zeros((3, 2), np.float32))


def test_some_worlds_may_get_a_seed_of_their_own():
    envs = gymnasium.make_vec("Safexp-PointGoal2-v0", num_envs=3, config=SHORT)
    first, _ = envs.reset(seed=np.array([3, 11, 3]))
    np.testing.assert_array_equal(first[0], first[2])
    again, _ = envs.reset(seed=[None, 11, None])
    np.testing.assert_array_equal(again[1], first[1])
    assert (again[0] != first[0]).any()
    with pytest.raises(ValueError, match="There must be 3 seeds, got 2"):
        envs.reset(seed=[1, 2])


@pytest.mark.parametrize("flatten", [True, False])
def test_observations_that_have_bounds_are_given_them(flatten):
    config = {"observe_goal_comp": True, "observe_goal_dist": True, "compass_shape": 3}
    config |= {"observation_flatten": flatten, "observe_remaining": True}
    bounds = {"goal_compass": (-1, 1), "goal_dist": (0, 1)}
    bounds |= {f"{kind}_lidar": (0, 1) for kind in ("goal", "hazards", "vases")}
    env = gymnasium.make("Safexp-CarGoal2-v0", config=config).unwrapped
    for name, columns in env.batch.observation_layout.items():
        box = env.observation_space if flatten else env.observation_space[name]
        rows = columns if flatten else slice(None)
        low, high = bounds.get(name, (-np.inf, np.inf))
        assert (box.low[rows] == low).all(), name
        assert (box.high[rows] == high).all(), name


def test_the_example_of_a_loop_finds_the_costs_of_episodes(capsys):
    first, second = gymnasium_loop.train(num_steps=20, updates=2, limit=-1.0)
    assert second > first >= 0.01
    assert capsys.readouterr().out.count("8 episodes") == 2


def test_torchrls_wrapper_makes_them_by_their_ids():
    """It asks for a frameskip first, and goes on without one if Python says so."""
    env = GymEnv("Safexp-PointGoal1-v0", config=SHORT)
    assert env.rollout(5).shape == (3,)
