"""Every trajectory follows from the seed of its row, and every future from a state."""

import gc
import weakref

import pytest
import torch
from crafting import assert_same, play

from safe_rl.envs import SafetyGymEnv, resolve
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv, resolve_velocity

# Short episodes and large goals, so that the compared steps include resets and new goals. Where a
# goal ends the episode, single rows are reset.
BUSY = {"num_steps": 20}
CONFIGS = {
    "goal": resolve("PointGoal2").replace(
        **BUSY, goal_size=1.8, continue_goal=False, gremlins_num=2, observe_gremlins=True
    ),
    "button": resolve("CarButton2").replace(**BUSY, buttons_size=0.2),
    "push": resolve("DoggoPush2").replace(**BUSY, goal_size=1.0),
    "noise": resolve("PointPush1").replace(**BUSY, action_noise=0.3, frameskip_binom_p=0.7),
}
# With random actions, goals are often met only in these.
MEETS_GOALS = ("goal", "push")
NAMES = [*CONFIGS, "SafeHopperVelocity", "SafeAntVelocity"]
CONFIGS["nested"] = resolve("CarGoal1").replace(**BUSY, observation_flatten=False, layout_seeds=3)
CONFIGS["one layout"] = resolve("PointPush1").replace(**BUSY, randomize_layout=False)


def make(name: str, num_envs: int, seed: int | None = 0, num_threads: int = 1, **sleep: bool):
    """Of either family; robots of the velocity family do not sleep."""
    settings = {"num_envs": num_envs, "seed": seed, "num_threads": num_threads}
    if name in VELOCITY_SUITE:
        return VelocityEnv(resolve_velocity(name).replace(num_steps=12), **settings)
    return SafetyGymEnv(CONFIGS[name], **settings, **sleep)


@pytest.mark.parametrize("name", NAMES)
def test_threads_and_batch_size_do_not_matter(name):
    few, many = make(name, 3), make(name, 8, num_threads=2)
    run, larger = play(few, few.reset(), 25), play(many, many.reset(), 25)
    assert_same(run, larger[:3])
    assert run["done"].any()
    if name in MEETS_GOALS:
        assert larger["goal_met"].any()


@pytest.mark.parametrize("name", NAMES)
def test_seeds_rows_and_episodes_differ(name):
    envs = [make(name, 4, seed=seed) for seed in (0, 1)]
    starts = [env.reset()["observation"] for env in envs for _ in range(2)]
    assert len(torch.cat(starts).unique(dim=0)) == 16


@pytest.mark.parametrize("name", ["goal", "SafeHopperVelocity"])
def test_seeding_starts_over(name):
    env = make(name, 3, seed=5)
    runs = [play(env, env.reset(), 30)]
    env.set_seed(5)
    runs.append(play(env, env.reset(), 30))
    assert_same(*runs)
    env.set_seed(6)
    assert not torch.equal(env.reset()["observation"], runs[0]["observation"][:, 0])
    with pytest.raises(TypeError, match=r"reset takes no seed; call env\.set_seed"):
        env.reset(seed=5)


@pytest.mark.parametrize("name", ["goal", "SafeHopperVelocity"])
def test_without_a_seed_torch_decides(name):
    starts = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        starts.append(make(name, 2, seed=None).reset()["observation"])
    assert torch.equal(starts[0], starts[1])
    assert not torch.equal(starts[0], starts[2])


@pytest.mark.parametrize("name", [*NAMES, "nested", "one layout"])
def test_a_state_determines_the_future_and_setting_it_interrupts_nothing(name):
    """Through new goals and resets; also in another instance."""
    plain, interrupted = make(name, 4, sleep=False), make(name, 4, sleep=False)
    first = play(plain, plain.reset(), 8)
    play(interrupted, interrupted.reset(), 8)
    state = interrupted.get_state()
    tensordict, kept = interrupted.set_state(state), state.clone()
    assert_same(interrupted.get_state(), state)
    going = ~first["done"][:, -1, 0]
    assert going.any()
    assert (tensordict["observation"][going] == first["observation"][going, -1]).all()
    run = play(plain, tensordict.clone(), 34)
    assert_same(run, play(interrupted, tensordict.clone(), 34))
    elsewhere = make(name, 4, seed=99, num_threads=2, sleep=False)
    assert_same(run, play(elsewhere, elsewhere.set_state(state), 34))
    assert_same(state, kept)
    assert run["done"].sum() >= 8
    if name in MEETS_GOALS:
        assert run["goal_met"].any()


def test_layout_and_seeds_may_be_left_out_of_a_state():
    env = make("goal", 3, sleep=False)
    env.rollout(5)
    state = env.get_state()
    observation = env.set_state(state)["observation"]
    env.rollout(5)
    required = ("qpos", "qvel", "qacc_warmstart", "time", "goal_pos", "goal_button")
    partial = state.select(*required, "buttons_timer", "step_count", "ctrl")
    episode = env.get_state()["episode"]
    lidars = [span for name, span in env.observation_layout.items() if name != "hazards_lidar"]
    for span in lidars:
        assert torch.equal(env.set_state(partial)["observation"][:, span], observation[:, span])
    assert torch.equal(env.get_state()["episode"], episode)


def test_nothing_keeps_an_environment_that_is_no_longer_used():
    env = make("goal", 3)
    env.rollout(2)
    physics = weakref.ref(env._physics)
    del env
    gc.collect()
    assert physics() is None
