"""Gymnasium's interfaces: its own checkers, its own vector environment as a reference."""

import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from pictures import MISSING_OPENGL, needs_opengl
from tensordict import TensorDict

from safe_rl.envs import EXTRAS, SUITE, ConfigError, OpenGLError, SafetyGymEnv

IDS = [f"Safexp-{name}-v0" for name in (*SUITE, *EXTRAS)]
SHORT = {"num_steps": 3}
MODES = list(AutoresetMode)


def test_every_name_is_registered():
    registered = {env_id for env_id in gymnasium.registry if env_id.startswith("Safexp-")}
    assert registered == {*IDS, "Safexp-Custom-v0"}
    assert gymnasium.make("safe_rl.envs:Safexp-PointGoal0-v0").observation_space.shape == (28,)


@pytest.mark.parametrize(
    "env_id",
    [
        *("Safexp-PointGoal1-v0", "Safexp-CarButton2-v0", "Safexp-DoggoPush1-v0"),
        *("Safexp-PointRun-v0", "Safexp-Custom-v0"),
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


@pytest.mark.parametrize("name", SUITE)
def test_spaces_fit_what_is_returned(name):
    env = gymnasium.make(f"Safexp-{name}-v0", disable_env_checker=True)
    observation, info = env.reset(seed=0)
    assert info == {}
    assert observation in env.observation_space
    observation, *_ = env.step(env.action_space.sample())
    assert observation in env.observation_space
    assert (
        env.observation_space.shape == SafetyGymEnv(name).observation_spec["observation"][0].shape
    )


def test_steps_are_those_of_the_batched_environment():
    single = gymnasium.make("Safexp-CarGoal2-v0")
    batch = SafetyGymEnv("CarGoal2", num_envs=1, seed=11)
    observation, _ = single.reset(seed=11)
    tensordict = batch.reset()
    np.testing.assert_array_equal(observation, tensordict["observation"][0])
    action = np.array([1.0, 0.9], dtype=np.float32)
    costs = 0.0
    for _ in range(300):
        observation, reward, terminated, truncated, info = single.step(action)
        tensordict["action"] = torch.from_numpy(action)[None]
        step = batch.step(tensordict)["next"]
        np.testing.assert_array_equal(observation, step["observation"][0])
        assert reward == step["reward"].item()
        assert (terminated, truncated) == (False, False)
        assert set(info) == {*batch.cost_keys, "goal_met"}
        assert {key: step[key].item() for key in info} == info
        costs += info["cost"]
        tensordict = batch.step_mdp(TensorDict({"next": step}, [1]))
    assert costs > 0


def test_a_seed_determines_this_episode_and_the_next():
    env = gymnasium.make("Safexp-PointGoal1-v0", config=SHORT)
    episodes = [(env.reset(seed=seed)[0], env.reset()[0]) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(episodes[0], episodes[1])
    assert (episodes[0][0] != episodes[2][0]).any()
    assert (episodes[0][0] != episodes[0][1]).any()
    unseeded = [gymnasium.make("Safexp-PointGoal1-v0").reset()[0] for _ in range(2)]
    assert (unseeded[0] != unseeded[1]).any()


def test_seeding_leaves_the_generators_of_others_alone():
    torch.manual_seed(3)
    expected = torch.rand(3)
    torch.manual_seed(3)
    env = gymnasium.make("Safexp-PointGoal1-v0")
    env.reset(seed=5)
    env.reset()
    torch.testing.assert_close(torch.rand(3), expected)


def test_time_outs_are_truncations_and_met_goals_can_terminate():
    env = gymnasium.make("Safexp-PointGoal1-v0", config=SHORT)
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    # A goal as large as the arena is met by the first step.
    at_goal = {"continue_goal": False, "goal_size": 9.0}
    env = gymnasium.make("Safexp-PointGoal0-v0", config=at_goal)
    env.reset(seed=0)
    *_, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert (terminated, truncated, info["goal_met"]) == (True, False, True)


def test_any_configuration_can_be_made():
    config = {"robot_base": "point", "hazards_num": 2, "constrain_hazards": True}
    env = gymnasium.make("Safexp-Custom-v0", config=config)
    env.reset(seed=0)
    assert "cost_hazards" in env.step(env.action_space.sample())[-1]
    changed = gymnasium.make("Safexp-PointGoal1-v0", config={"lidar_num_bins": 8})
    assert changed.observation_space.shape == (12 + 3 * 8,)
    whole = gymnasium.make("Safexp-PointGoal1-v0", config=SUITE["CarPush0"])
    assert (
        whole.observation_space.shape
        == gymnasium.make("Safexp-CarPush0-v0").observation_space.shape
    )
    with pytest.raises(ConfigError, match="Did you mean 'hazards_num'"):
        gymnasium.make("Safexp-Custom-v0", config={"hazard_num": 2})


def test_nested_observations_are_dictionaries():
    env = gymnasium.make("Safexp-CarGoal1-v0", config={"observation_flatten": False})
    observation, _ = env.reset(seed=0)
    assert isinstance(env.observation_space, gymnasium.spaces.Dict)
    assert observation in env.observation_space
    flat, _ = gymnasium.make("Safexp-CarGoal1-v0").reset(seed=0)
    joined = [observation[key].reshape(-1) for key in sorted(observation)]
    np.testing.assert_array_equal(np.concatenate(joined), flat)


@needs_opengl
def test_record_video(tmp_path):
    pytest.importorskip("moviepy", reason="RecordVideo writes films with moviepy")
    env = gymnasium.make(
        "Safexp-PointGoal1-v0", render_mode="rgb_array", width=64, height=48, config=SHORT
    )
    films = tmp_path / "films"
    env = gymnasium.wrappers.RecordVideo(env, str(films), episode_trigger=lambda _: True)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.close()
    assert [path.suffix for path in films.iterdir() if path.stat().st_size > 500] == [".mp4"]


@needs_opengl
def test_frames_are_what_the_camera_sees():
    make = {"render_mode": "rgb_array", "camera": "track", "width": 64, "height": 48}
    env = gymnasium.make("Safexp-PointGoal1-v0", **make)
    env.reset(seed=4)
    batch = SafetyGymEnv("PointGoal1", seed=4)
    batch.reset()
    expected = batch.render(0, camera="track", width=64, height=48)
    np.testing.assert_array_equal(env.render(), expected)
    envs = gymnasium.make_vec("Safexp-PointGoal1-v0", num_envs=2, **make)
    envs.reset(seed=4)
    frames = envs.render()
    assert len(frames) == 2
    np.testing.assert_array_equal(frames[0], expected)


def test_stable_baselines3s_checker_has_nothing_to_say():
    checker = pytest.importorskip(
        "stable_baselines3.common.env_checker", reason="Stable-Baselines3 is not installed"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for env_id in ("Safexp-PointGoal1-v0", "Safexp-DoggoButton2-v0"):
            checker.check_env(gymnasium.make(env_id))


@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_the_human_mode_needs_a_screen(make, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(OpenGLError, match=r"no screen.*rgb_array"):
        make("Safexp-PointGoal1-v0", render_mode="human")


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
    """Goals that end episodes make them end at different times; every row goes on as if alone."""
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


def test_specs_say_how_long_episodes_are_and_time_is_up_once():
    make = {"id": "Safexp-PointGoal1-v0", "config": {"num_steps": 1200}}
    env = gymnasium.make(**make)
    assert env.spec.max_episode_steps == 1200
    assert gymnasium.make("Safexp-PointGoal1-v0").spec.max_episode_steps == 1000
    env.reset(seed=0)
    ends = [any(env.step(np.zeros(2, np.float32))[2:4]) for _ in range(1200)]
    assert ends == [False] * 1199 + [True]
    for wrapped in (env, gymnasium.wrappers.TransformReward(env, abs)):
        assert wrapped.spec.max_episode_steps == 1200
    assert gymnasium.make(env.spec).spec.max_episode_steps == 1200
    envs = gymnasium.make_vec(**make, num_envs=2)
    assert envs.spec.max_episode_steps == 1200
    assert gymnasium.make_vec(envs.spec).unwrapped.batch.max_episode_steps == 1200
    short = gymnasium.make_vec(**make, num_envs=2, max_episode_steps=3)
    short.reset(seed=0)
    ends = [short.step(np.zeros((2, 2), np.float32))[3].all() for _ in range(3)]
    assert ends == [False, False, True]


def test_the_originals_environments_for_tests():
    """Numbers of the original: components of the observation, hazards, and a straight way."""
    ids = {env_id for env_id in gymnasium.registry if env_id.startswith("Testing-")}
    grids = [f"{robot}Grid{way}" for robot in ("Point", "Car", "Doggo") for way in "0124"]
    grids += [f"{robot}GridWall" for robot in ("Point", "Car", "Doggo")]
    assert ids == {f"Testing-{name}-v0" for name in grids}
    # accelerometer, velocimeter, gyro, magnetometer; goal and hazards lidar; remaining
    env = gymnasium.make("Testing-PointGridWall-v0", positions=True, sleep=False)
    assert env.observation_space.shape == (4 * 3 + 2 * 10 + 1,)
    _, info = env.reset(seed=0)
    hazards = info["positions"]["hazards"][:, :2]
    assert len({tuple(place) for place in hazards.round(3).tolist()}) == 42
    np.testing.assert_allclose(info["positions"]["goal"], [[0, 10, 0.26]], atol=1e-6)
    assert (abs(info["positions"]["robot"][0, :2]) <= 1).all()
    for robot in ("Car", "Doggo"):
        env = gymnasium.make(f"Testing-{robot}Grid1-v0", config={"goal_locations": [(0, 0)],
            "goal_size": 9.0, "goal_keepout": 0.0, "robot_keepout": 0.0})  # fmt: skip
        env.reset(seed=0)
        *_, terminated, _, info = env.step(np.zeros(env.action_space.shape, np.float32))
        assert terminated
        assert info["goal_met"]


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
