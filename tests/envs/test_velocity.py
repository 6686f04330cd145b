"""The velocity family as TorchRL environments: specs, episodes, seeds, snapshots, failures."""

import math

import pytest
import torch
from playing import assert_same, play
from torchrl.envs import check_env_specs

from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv

NUM_STEPS = 12  # short episodes, so that resets are among the compared steps
FALLING = [name for name, row in VELOCITY_SUITE.items() if row.healthy_reward is not None]
STEADY = [name for name in VELOCITY_SUITE if name not in FALLING]


def make(name, num_envs, seed=0, num_steps=NUM_STEPS, num_threads=1, **keys):
    config = VELOCITY_SUITE[name].replace(num_steps=num_steps, **keys)
    return VelocityEnv(config, num_envs=num_envs, seed=seed, num_threads=num_threads)


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_specs(name):
    env = make(name, 2)
    check_env_specs(env)
    assert env.cost_keys == ["cost", "cost_velocity"]
    assert list(env.full_reward_spec.keys()) == ["reward", *env.cost_keys]
    columns = [number for span in env.observation_layout.values() for number in range(300)[span]]
    assert columns == list(range(env.observation_spec["observation"].shape[-1]))[:300]
    assert env.max_episode_steps == NUM_STEPS


@pytest.mark.parametrize("name", FALLING)
def test_fallen_robots_terminate_and_start_anew(name):
    env = make(name, 8, num_steps=200)
    run = play(env, env.reset(), 120)
    assert run["terminated"].any()
    assert torch.equal(run["done"], run["terminated"] | run["truncated"])
    assert not (run["terminated"] & run["truncated"]).any()
    reward = run["reward"][run["terminated"]]
    staying = make(name, 8, num_steps=200, terminate_when_unhealthy=False)
    assert not play(staying, staying.reset(), 120)["terminated"].any()
    assert reward.isfinite().all()


def test_starts_depend_on_seed_row_and_episode_alone():
    """Whoever started an episode before, and however often."""
    seen = []
    for lonely in (range(0), range(3), range(1, 4)):
        env = make("SafeAntVelocity", 4, seed=3)
        tensordict = env.reset()
        for row in lonely:
            mask = torch.zeros(4, 1, dtype=torch.bool)
            mask[row] = True
            tensordict = env.reset(tensordict.set("_reset", mask))
        while not (env.get_state()["episode"] >= 3).all():
            behind = (env.get_state()["episode"] < 3)[:, None]
            tensordict = env.reset(tensordict.set("_reset", behind))
        seen.append(env.get_state().select("qpos", "qvel", "episode"))
    assert all((state["episode"] == 3).all() for state in seen)
    assert_same(seen[0], seen[1])
    assert_same(seen[0], seen[2])


FAULTS = {"nan": math.nan, "infinite": math.inf, "huge": 1e30}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("SafeHopperVelocity", {}),
        ("SafeHalfCheetahVelocity", {}),
        ("SafeAntVelocity", {"frame_skip": 1}),  # where forces are computed
        ("SafeAntVelocity", {"frame_skip": 3}),
    ],
)
def test_failures_stay_in_their_row(name, keys, fault):
    env, healthy = make(name, 4, **keys), make(name, 4, **keys)
    start = env.reset()
    state = env.get_state()
    state["qvel"][1, 0] = FAULTS[fault]
    action = healthy.rand_action(healthy.reset())["action"]
    written = env.step(env.set_state(state).set("action", action))["next"]
    wanted = healthy.step(start.set("action", action))["next"]
    assert written["terminated"][:, 0].tolist()[1]
    for key in ("reward", "cost", "cost_velocity"):
        assert written[key][1].item() == 0.0
    assert written["observation"].isfinite().all()
    others = [0, 2, 3]
    assert_same(written[others], wanted[others])
    _, restarted = env.step_and_maybe_reset(
        env.reset(written.set("_reset", written["done"])).set("action", action)
    )
    assert restarted["observation"].isfinite().all()


def test_actions_that_are_no_numbers_fail_their_row_only():
    for name, keys in (("SafeHopperVelocity", {}), ("SafeAntVelocity", {"frame_skip": 1})):
        env = make(name, 3, **keys)
        tensordict = env.rand_action(env.reset())
        tensordict["action"][1] = math.nan
        written = env.step(tensordict)["next"]
        assert written["terminated"][:, 0].tolist() == [False, True, False]
        assert all(value.to(torch.float64).isfinite().all() for value in written.values())
