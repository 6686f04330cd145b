"""What goes wrong in one world stays there, and what is wrong with an input is said."""

import math
import multiprocessing

import pytest
import torch
from tensordict import TensorDict

from safe_rl.envs import SUITE, ConfigError, SafetyGymEnv, make_env

BROKEN, NUM_ENVS = 1, 4


def make(name: str = "PointGoal2", **changes) -> SafetyGymEnv:
    config = SUITE[name].replace(**changes)
    return SafetyGymEnv(config, num_envs=NUM_ENVS, seed=0, num_threads=1)


def step_with(env, action_of_broken=None, velocity=None) -> TensorDict:
    """A few good steps, then one with something wrong in the broken row, if anything."""
    torch.manual_seed(0)
    tensordict = env.step_mdp(env.rollout(3)[:, -1])
    action = env.action_spec.rand()
    if action_of_broken is not None:
        action[BROKEN] = action_of_broken
    if velocity is not None:
        state = env.get_state()
        state["qvel"][BROKEN, 0] = velocity
        tensordict = env.set_state(state)
    return env.step(tensordict.set("action", action))["next"]


FAULTS = {
    "nan action": {"action_of_broken": math.nan},
    "infinite velocity": {"velocity": math.inf},
    "nan velocity": {"velocity": math.nan},
    "huge velocity": {"velocity": 1e30},
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["PointGoal2", "CarButton1", "DoggoPush2"])
def test_a_failing_world_ends_and_leaves_the_others_alone(name, fault):
    env, sane = make(name, reward_exception=-7.0), make(name)
    # The row that is all right in the comparison has its state set all the same.
    got = step_with(env, **FAULTS[fault])
    same = {"velocity": 0.0} if "velocity" in FAULTS[fault] else {}
    want = step_with(sane, **same)
    assert got["reward"][BROKEN] == -7.0
    for key in ("cost_exception", "cost", "terminated", "done"):
        assert got[key][BROKEN] == 1, key
    others = [key for key in env.cost_keys if key not in ("cost", "cost_exception")]
    assert not any(got[key][BROKEN] for key in (*others, "truncated", "goal_met"))
    assert got["observation"].isfinite().all()
    rows = torch.arange(NUM_ENVS) != BROKEN
    for key, value in want.items():
        assert torch.equal(got[key][rows], value[rows]), key
    assert not want["cost_exception"].any()


@pytest.mark.parametrize("fault", FAULTS)
def test_a_reset_heals(fault):
    env, healthy = make(), make()
    failed = step_with(env, **FAULTS[fault])
    tensordict = env.reset(failed.exclude("reward", *env.cost_keys).set("_reset", failed["done"]))
    # The second episode of a world that never failed.
    healthy.reset()
    want = healthy.reset()
    assert torch.equal(tensordict["observation"][BROKEN], want["observation"][BROKEN])
    for _ in range(20):
        following = env.step(env.rand_action(tensordict))
        assert not following["next", "cost_exception"].any()
        assert not following["next", "terminated"].any()
        tensordict = env.step_mdp(following)


WRONG_ACTIONS = {
    "too many actuators": torch.zeros(NUM_ENVS, 3),
    "flat": torch.zeros(NUM_ENVS),
    "integers": torch.zeros(NUM_ENVS, 2, dtype=torch.int64),
}


@pytest.mark.parametrize("action", WRONG_ACTIONS.values(), ids=WRONG_ACTIONS)
def test_wrong_actions(action):
    env = make()
    with pytest.raises(ValueError, match=r"'action'.*\(4, 2\)"):
        env.step(env.reset().set("action", action))


def test_actions_are_clipped_to_the_control_range():
    env = make()
    env.reset()
    state, results = env.get_state(), []
    for size in (1.0, 30.0):
        action = size * torch.tensor([[1.0, -1.0], [1, 1], [-1, 1], [-1, -1]])
        results.append(env.step(env.set_state(state).set("action", action))["next", "observation"])
    assert torch.equal(*results)


WRONG_CONFIGS = {
    "unknown key": ({"hazard_num": 3}, "'hazard_num'.*'hazards_num'"),
    "not finite": ({"robot_keepout": math.nan}, "'robot_keepout' must be a number from 0.*got nan"),
    "unknown task": ({"task": "gaol"}, "'task'.*Did you mean 'goal'"),
    "unknown robot": ({"robot_base": "dogo"}, "'robot_base'.*Did you mean 'doggo'"),
    "no such file": ({"robot_base": "nowhere.xml"}, "'robot_base'.*nowhere.xml"),
    "buttons missing": ({"task": "button"}, "buttons_num"),
    "unknown sensor": ({"sensors_obs": ["gyros"]}, "'sensors_obs'.*Did you mean 'gyro'"),
    "no free joint": ({"observe_freejoint": True}, "'observe_freejoint'.*'observe_qpos'"),
    "nothing observed": ({"observe_sensors": False}, "observe_"),
}


@pytest.mark.parametrize(("values", "message"), WRONG_CONFIGS.values(), ids=WRONG_CONFIGS)
def test_wrong_configurations(values, message):
    with pytest.raises(ConfigError, match=message):
        SafetyGymEnv({"robot_base": "point", **values}, num_threads=1)


def test_states_that_do_not_fit():
    env = make()
    env.reset()
    state = env.get_state()
    with pytest.raises(KeyError, match="qvel"):
        env.set_state(state.exclude("qvel"))
    with pytest.raises(ValueError, match=r"'qpos'.*\(4, 73\).*\(4, 5\)"):
        env.set_state(state.clone().set("qpos", torch.zeros(NUM_ENVS, 5)))


@pytest.mark.parametrize(
    "arguments",
    [{"num_envs": 0}, {"num_envs": 2.5}, {"num_threads": -1}, {"seed": "one"}, {"seed": 2**63}],
)
def test_wrong_counts_and_seeds_are_named(arguments):
    (name,) = arguments
    with pytest.raises(ConfigError, match=f"'{name}' must be an integer"):
        SafetyGymEnv("PointGoal0", **arguments)


def test_a_goal_button_that_does_not_exist_is_refused():
    env = SafetyGymEnv("PointButton0", num_envs=2, seed=0)
    env.reset()
    state = env.get_state()
    state["goal_button"] = torch.tensor([0, 4])
    with pytest.raises(ValueError, match="between 0 and 3"):
        env.set_state(state)


WRONG_STATES = {
    "seeds of more rows": ("seed", torch.zeros(5, dtype=torch.int64), r"'seed'.*\(4,\).*\(5,\)"),
    "seeds that are fractions": ("seed", torch.zeros(4), "'seed' must be torch.int64"),
    "episodes of fewer rows": ("episode", torch.ones(2, dtype=torch.int64), r"'episode'.*\(4,\)"),
}


@pytest.mark.parametrize("name", ["PointGoal2", "SafeHopperVelocity"])
@pytest.mark.parametrize(("key", "value", "message"), WRONG_STATES.values(), ids=WRONG_STATES)
def test_states_with_wrong_seeds_are_refused_and_leave_all_as_it_was(name, key, value, message):
    env = make_env(name, num_envs=NUM_ENVS, seed=0, num_threads=1)
    env.reset()
    before = env.get_state()
    wrong = {k: v for k, v in before.items() if k != key} | {key: value}
    with pytest.raises(ValueError, match=message):
        env.set_state(TensorDict(wrong))
    assert all(torch.equal(env.get_state()[k], v) for k, v in before.items())


@pytest.mark.parametrize("name", ["PointGoal1", "PointButton1", "SafeHopperVelocity"])
def test_a_step_before_the_first_reset_says_so(name):
    env = make_env(name, num_envs=3, seed=0, num_threads=1)
    ask = TensorDict({"action": env.action_spec.zero()}, [3])
    with pytest.raises(RuntimeError, match=r"No episode has begun: call reset\(\)"):
        env.step(ask.clone())
    env.reset(TensorDict({"_reset": torch.tensor([[True], [False], [True]])}, [3]))
    with pytest.raises(RuntimeError, match=r"of rows \[1\]"):
        env.step(ask.clone())
    env.reset()
    state = env.get_state()
    env.step(ask.clone())
    other = make_env(name, num_envs=3, seed=0, num_threads=1)
    other.set_state(state)
    other.step(ask)


def _step_forked(env: SafetyGymEnv, answers) -> None:
    try:
        env.reset()
        answers.put("it works")
    except RuntimeError as error:
        answers.put(str(error))


def test_a_fork_with_threads_is_an_error_instead_of_a_hang():
    context = multiprocessing.get_context("fork")
    env, answers = SafetyGymEnv("PointGoal0", num_envs=4, num_threads=2), context.Queue()
    env.reset()
    child = context.Process(target=_step_forked, args=(env, answers), daemon=True)
    child.start()
    try:
        assert "num_threads=1" in answers.get(timeout=300)
    finally:
        child.kill()
        child.join(300)
