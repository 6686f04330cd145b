"""What goes wrong in one world stays there, and what is wrong with an input is said."""

import math
import multiprocessing

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from safe_rl.envs import ConfigError, SafetyGymConfig, SafetyGymEnv, env_node, make_env

BROKEN, NUM_ENVS = 1, 4


def make(name: str = "PointGoal2", **changes):
    return make_env({**env_node(name), **changes}, num_envs=NUM_ENVS, seed=0, num_threads=1)


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
    "nan velocity": {"velocity": math.nan},
    "huge velocity": {"velocity": 1e30},
}


MADE = [
    *((name, {"reward_exception": -7.0}) for name in ("PointGoal2", "DoggoPush2")),
    ("SafeHopperVelocity", {}),
    *(("SafeAntVelocity", {"frame_skip": skip}) for skip in (1, 3)),  # where forces are computed
]


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize(("name", "keys"), MADE)
def test_a_failing_world_ends_and_leaves_the_others_alone(name, keys, fault):
    env, sane = make(name, **keys), make(name, **keys)
    # In the comparison, the state of this row is set too, but to one that does not fail.
    got = step_with(env, **FAULTS[fault])
    want = step_with(sane, **({"velocity": 0.0} if "velocity" in FAULTS[fault] else {}))
    assert got["reward"][BROKEN] == keys.get("reward_exception", 0.0)
    told = ("cost", "cost_exception") if "cost_exception" in env.cost_keys else ()
    for key in (*told, "terminated", "done"):
        assert got[key][BROKEN] == 1, key
    for key in {*env.cost_keys, *env.flags} - {*told, "terminated", "done"}:
        assert got[key][BROKEN] == 0, key
    assert got["observation"].isfinite().all()
    rows = torch.arange(NUM_ENVS) != BROKEN
    for key, value in want.items():
        assert torch.equal(got[key][rows], value[rows]), key


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["PointGoal2", "SafeHalfCheetahVelocity"])
def test_a_reset_heals(name, fault):
    env, healthy = make(name), make(name)
    failed = step_with(env, **FAULTS[fault])
    tensordict = env.reset(failed.exclude("reward", *env.cost_keys).set("_reset", failed["done"]))
    # The second episode of a world that never failed.
    healthy.reset()
    want = healthy.reset()
    assert torch.equal(tensordict["observation"][BROKEN], want["observation"][BROKEN])
    after = env.rollout(20, auto_reset=False, tensordict=tensordict, break_when_any_done=False)
    assert not after["next", "terminated"].any()


def test_wrong_actions():
    env = make()
    for action in (torch.zeros(NUM_ENVS, 3), torch.zeros(NUM_ENVS, 2, dtype=torch.int64)):
        with pytest.raises(ValueError, match=r"'action'.*\(4, 2\)"):
            env.step(env.reset().set("action", action))
    with pytest.raises(KeyError, match="action"):
        env.step(env.reset())


def test_actions_are_clipped_to_the_control_range():
    env = make_env("SafeHumanoidVelocity", num_envs=NUM_ENVS, seed=0, num_threads=1)
    env.reset()
    state, results = env.get_state(), []
    for size in (1.0, 30.0):
        action = size * env.action_spec.space.high
        results.append(env.step(env.set_state(state).set("action", action))["next", "observation"])
    assert torch.equal(*results)


WRONG_CONFIGS = {
    "unknown task": ({"task": "gaol"}, "'task'.*Did you mean 'goal'"),
    "unknown robot": ({"robot_base": "dogo"}, "'robot_base'.*Did you mean 'doggo'"),
    "no key": ({"num_env": 4}, "'num_env'. Did you mean 'num_envs'"),
    "no such file": ({"robot_base": "nowhere.xml"}, "'robot_base'.*nowhere.xml"),
    "buttons missing": ({"task": "button"}, "buttons_num"),
    "unknown sensor": ({"sensors_obs": ["gyros"]}, "'sensors_obs'.*Did you mean 'gyro'"),
    "no free joint": ({"observe_freejoint": True}, "'observe_freejoint'.*'observe_qpos'"),
    "nothing observed": ({"observe_sensors": False}, "observe_"),
    "no boundary": ({"constrain_boundary": True}, "needs 'boundary_x', 'boundary_y'"),
    "no speed": ({"constrain_velocity": True}, "'constrain_velocity' needs 'velocity_limit'"),
    "no hazards": ({"hazards_locations": [[0, 0]]}, "'hazards_locations' has 1 .* for 0 objects"),
    "idle boundary": ({"boundary_x": 1.0}, "'boundary_x' has no effect.*'constrain_boundary'"),
    "idle weight": ({"hazards_cost": 5.0}, "'hazards_cost' has no effect.*'constrain_indicator'"),
    "no vases": ({"constrain_vases": True}, "'constrain_vases' has no effect.*'vases_num' is 0"),
}


@pytest.mark.parametrize(("values", "message"), WRONG_CONFIGS.values(), ids=WRONG_CONFIGS)
def test_wrong_configurations(values, message):
    with pytest.raises((ConfigError, UserWarning), match=message):
        SafetyGymEnv({"robot_base": "point", **values}, num_threads=1)


def test_failing_physics_is_told_once(capfd):
    env = make("PointGoal0")
    no_number = torch.full((NUM_ENVS, 2), math.nan)
    with pytest.warns(RuntimeWarning, match="of 4 of 4 simulations failed") as told:
        env.rollout(3, lambda td: td.set("action", no_number), break_when_any_done=False)
    assert len(told) == 1
    assert "WARNING" not in "".join(capfd.readouterr())


WRONG_STATES = {
    "qpos": (torch.zeros(NUM_ENVS, 5), r"'qpos'.*\(4, 45\).*\(4, 5\)"),
    "seed": (torch.zeros(NUM_ENVS), "'seed' must be torch.int64"),
    "episode": (torch.ones(2, dtype=torch.int64), r"'episode'.*\(4,\)"),
    "goal_button": (torch.tensor([0, 4, 0, 0]), "between 0 and 3"),
}


def test_states_that_do_not_fit_are_refused_and_leave_all_as_it_was():
    env = make("PointButton2")
    env.reset()
    before = env.get_state()
    with pytest.raises(KeyError, match="qvel"):
        env.set_state(before.exclude("qvel"))
    for key, (value, message) in WRONG_STATES.items():
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


def test_a_file_of_ones_own_is_not_taken_for_the_bundled_one(tmp_path, monkeypatch):
    (tmp_path / "xmls").mkdir()
    (tmp_path / "xmls" / "car.xml").write_text("<mujoco/>")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"xmls/car\.xml has no body"):
        SafetyGymEnv({"robot_base": "xmls/car.xml"})


def test_more_locations_than_objects_are_told_and_ignored():
    keys = {"robot_base": "point", "hazards_num": 1, "hazards_locations": [[1, 0], [0, 1]]}
    with pytest.warns(UserWarning, match="'hazards_locations' has 2 locations for 1 objects"):
        env = SafetyGymEnv(keys, num_threads=1)
    env.reset()
    assert env.get_positions()["hazards"][0, :, :2].tolist() == [pytest.approx([1, 0], abs=1e-6)]


def test_values_of_numpy_are_those_of_python():
    given = {
        **{"hazards_num": np.int64(3), "num_steps": np.float32(7.0), "task": np.str_("push")},
        **{"constrain_hazards": np.True_, "goal_size": np.float64(0.5)},
        **{"placements_extents": np.array([-3, -3, 3, 3]), "sensors_obs": np.array(["gyro"])},
    }
    plain = {key: value.tolist() for key, value in given.items()}
    config = SafetyGymConfig(**given)
    assert config == SafetyGymConfig(**plain)
    assert {type(config.hazards_num), type(config.num_steps)} == {int}
    assert config.constrain_hazards is True
    for wrong in ({"hazards_num": np.True_}, {"lidar_alias": np.int8(1)}):
        with pytest.raises(ConfigError):
            SafetyGymConfig(**wrong)
