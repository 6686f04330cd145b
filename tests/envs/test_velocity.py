"""The velocity family as TorchRL environments: specs, episodes, seeds, snapshots, failures."""

import itertools
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv

NUM_STEPS = 12  # short episodes, so that resets are among the compared steps
FALLING = [name for name, row in VELOCITY_SUITE.items() if row.healthy_reward is not None]
STEADY = [name for name in VELOCITY_SUITE if name not in FALLING]


def make(name, num_envs, seed=0, num_steps=NUM_STEPS, num_threads=1, **keys):
    config = VELOCITY_SUITE[name].replace(num_steps=num_steps, **keys)
    return VelocityEnv(config, num_envs=num_envs, seed=seed, num_threads=num_threads)


def play(env, start, num_steps):
    """All outputs of a run with resets [N, T]; row k gets the same actions whatever N is."""
    num_envs, size = env.action_spec.shape
    high = env.action_spec.space.high[0]
    rows = [
        2 * torch.rand(num_steps, size, generator=torch.Generator().manual_seed(row)) - 1
        for row in range(num_envs)
    ]
    steps, tensordict = [], start
    for action in torch.stack(rows, 1) * high:
        following, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
        steps.append(following["next"].clone())
    return torch.stack(steps, 1)


def assert_same(a, b):
    assert set(a.keys()) == set(b.keys())
    for key, value in a.items():
        assert torch.equal(value, b[key]), key


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_specs(name):
    env = make(name, 2)
    check_env_specs(env)
    assert env.cost_keys == ["cost", "cost_velocity"]
    assert list(env.full_reward_spec.keys()) == ["reward", *env.cost_keys]
    columns = [number for span in env.observation_layout.values() for number in range(300)[span]]
    assert columns == list(range(env.observation_spec["observation"].shape[-1]))[:300]
    assert env.max_episode_steps == NUM_STEPS


def test_benchmark_episodes_have_1000_steps():
    env = VelocityEnv("SafeSwimmerVelocity", num_envs=2, seed=0, num_threads=1)
    assert env.max_episode_steps == 1000
    last = env.rollout(1100)["next"]
    assert last.shape == (2, 1000)
    assert last["truncated"][:, -1].all()
    assert not last["truncated"][:, :-1].any()
    assert not last["terminated"].any()


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


def test_rows_time_out_by_their_own_count():
    env = make("SafeSwimmerVelocity", 2, num_steps=5)
    tensordict, ends = env.reset(), []
    for step in range(12):
        following, tensordict = env.step_and_maybe_reset(env.rand_action(tensordict))
        ends.append(following["next", "truncated"][:, 0].tolist())
        if step == 1:
            tensordict = env.reset(tensordict.set("_reset", torch.tensor([[True], [False]])))
    assert [step for step, end in enumerate(ends) if end[0]] == [6, 11]
    assert [step for step, end in enumerate(ends) if end[1]] == [4, 9]


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_threads_and_batch_size_do_not_matter(name):
    few, many = make(name, 3), make(name, 7, num_threads=2)
    run, larger = play(few, few.reset(), 30), play(many, many.reset(), 30)
    assert_same(run, larger[:3])
    assert run["done"].any()


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_seeds_rows_and_episodes_differ(name):
    envs = [make(name, 4, seed=seed) for seed in (0, 1)]
    starts = [env.reset()["observation"] for env in envs for _ in range(2)]
    assert len(torch.cat(starts).unique(dim=0)) == 16


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


def test_seeding_starts_over():
    env = make("SafeHopperVelocity", 3, seed=5)
    runs = [play(env, env.reset(), 30)]
    env.set_seed(5)
    runs.append(play(env, env.reset(), 30))
    assert_same(*runs)
    torch.manual_seed(0)
    unseeded = [make("SafeHopperVelocity", 3, seed=None).reset()["observation"] for _ in range(2)]
    assert not torch.equal(*unseeded)


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_a_state_determines_the_future(name):
    """Branch, go on, come back, go on; also in another instance with other seeds."""
    env = make(name, 4)
    play(env, env.reset(), 7)
    state = env.get_state()
    kept = state.clone()
    went_on = env.set_state(state)
    assert_same(env.get_state(), state)
    runs = [play(env, went_on, 25), play(env, env.set_state(state), 25)]
    elsewhere = make(name, 4, seed=99, num_threads=2)
    runs.append(play(elsewhere, elsewhere.set_state(state), 25))
    assert_same(runs[0], runs[1])
    assert_same(runs[0], runs[2])
    assert_same(state, kept)
    assert runs[0]["done"].any()


@pytest.mark.parametrize("name", VELOCITY_SUITE)
def test_setting_the_present_state_interrupts_nothing(name):
    plain, interrupted = make(name, 4), make(name, 4)
    first = play(plain, plain.reset(), 7)
    assert_same(first, play(interrupted, interrupted.reset(), 7))
    tensordict = interrupted.set_state(interrupted.get_state())
    going = ~first["done"][:, -1, 0]
    assert torch.equal(tensordict["observation"][going], first["observation"][going, -1])
    run = play(plain, tensordict.clone(), 20)
    assert_same(run, play(interrupted, tensordict, 20))


@pytest.mark.parametrize("name", ["SafeHopperVelocity", "SafeAntVelocity", "SafeHumanoidVelocity"])
def test_partial_resets_leave_other_rows_alone(name):
    mask = torch.tensor([[True], [False], [True], [False]])
    kept = ~mask[:, 0]
    env = make(name, 4)
    tensordict = env.step_mdp(env.rollout(4, break_when_any_done=False)[:, -1])
    before, observation = env.get_state(), tensordict["observation"].clone()
    tensordict = env.reset(tensordict.set("_reset", mask))
    for key, value in env.get_state().items():
        assert torch.equal(value[kept], before[key][kept]), key
    assert torch.equal(tensordict["observation"][kept], observation[kept])
    assert not torch.equal(tensordict["observation"][~kept], observation[~kept])
    assert env.get_state()["step_count"].tolist() == [0, 4, 0, 4]


def test_a_reset_of_no_robot_changes_nothing():
    env = make("SafeAntVelocity", 2)
    before = env.rollout(3)[:, -1]["next"]
    state = env.get_state()
    nobody = before.set("_reset", torch.zeros(2, 1, dtype=torch.bool))
    assert torch.equal(env.reset(nobody)["observation"], before["observation"])
    assert_same(env.get_state(), state)


def test_nothing_that_is_returned_shares_memory():
    env = make("SafeAntVelocity", 3)
    first = env.reset()
    second = env.step(first.clone().set("action", env.action_spec.rand()))["next"]
    third = env.set_state(env.get_state())
    tensors = [value for result in (first, second, third) for value in result.values()]
    wanted = [value.clone() for value in tensors]
    env.rollout(3)
    assert all(map(torch.equal, tensors, wanted))
    for one, other in itertools.combinations(tensors, 2):
        before = other.clone()
        one.fill_(7).logical_not_()
        one.logical_not_()
        assert torch.equal(other, before)


FAULTS = {"nan": math.nan, "infinite": math.inf, "huge": 1e30}


@pytest.mark.parametrize("name", ["SafeHopperVelocity", "SafeHalfCheetahVelocity"])
@pytest.mark.parametrize("fault", FAULTS)
def test_failures_stay_in_their_row(name, fault):
    assert_failure_stays(name, fault, {})


@pytest.mark.parametrize("frame_skip", [1, 3])
@pytest.mark.parametrize("fault", FAULTS)
def test_failures_where_forces_are_computed_stay_in_their_row(fault, frame_skip):
    assert_failure_stays("SafeAntVelocity", fault, {"frame_skip": frame_skip})


def assert_failure_stays(name, fault, keys):
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


@pytest.mark.parametrize(
    "action", [torch.zeros(3, 2), torch.zeros(2, 3), torch.zeros(3, 3, dtype=torch.int64)]
)
def test_actions_of_wrong_shape_or_type_are_refused(action):
    env = make("SafeHopperVelocity", 3)
    with pytest.raises(ValueError, match=r"'action' must be a floating-point tensor"):
        env._step(TensorDict({"action": action}))


def test_states_that_do_not_fit_are_refused():
    env = make("SafeHopperVelocity", 3)
    env.reset()
    state = env.get_state()
    with pytest.raises(KeyError, match="lacks 'qvel'"):
        env.set_state(state.exclude("qvel"))
    with pytest.raises(ValueError, match="'qpos' must have shape"):
        env.set_state(make("SafeSwimmerVelocity", 3).get_state())


def test_costs_follow_the_threshold():
    slow = make("SafeSwimmerVelocity", 4, velocity_threshold=0.0)
    run = play(slow, slow.reset(), 11)
    moved = slow.get_state()["qpos"][:, 0]
    assert torch.equal(run["cost"], run["cost_velocity"])
    assert 0 < run["cost"].mean() < 1
    free = make("SafeSwimmerVelocity", 4, velocity_threshold=1e6)
    unlimited = play(free, free.reset(), 11)
    assert not unlimited["cost"].any()
    assert torch.equal(free.get_state()["qpos"][:, 0], moved)
    assert torch.equal(unlimited["reward"], run["reward"])
