"""Keys and environments registered from outside: Hydra, refused rows, the example's commands."""

import pickle
import runpy
from dataclasses import replace

import pytest
import torch
from commands import ROOT, SMALL, in_a_process, status_of
from registrations import POINT, disc, register_mines

from safe_rl.cli.evaluate import main as evaluate
from safe_rl.envs import (
    ConfigError,
    SafetyGymConfig,
    SafetyGymEnv,
)
from safe_rl.envs.extending import (
    Cost,
    Reading,
    Task,
    register_cost,
    register_element,
    register_observation,
    register_task,
)
from safe_rl.runs.table import read_table

pytestmark = pytest.mark.usefixtures("registrations_undone")


def test_registered_keys_are_keys_like_the_others():
    before = SafetyGymConfig(robot_base="point")
    register_mines()
    for wrong in ({"mines_num": 1001}, {"mines_size": 0.0}):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            SafetyGymConfig(**wrong)
    config = SafetyGymConfig(**POINT, mines_num=torch.tensor(2))
    assert (config.mines_size, config.mines_keepout, config.mines_cost) == (0.2, 0.3, 2.5)
    assert pickle.loads(pickle.dumps(config)) == config
    assert hash(pickle.loads(pickle.dumps(config))) == hash(config)
    assert config.replace(mines_num=0) != config
    # What was made before has the defaults of what it does not know.
    assert before.mines_num == 0
    assert before == SafetyGymConfig(robot_base="point")
    assert hash(before) == hash(SafetyGymConfig(robot_base="point"))
    assert before != SafetyGymConfig(robot_base="point", mines_num=1)
    assert before.replace(mines_num=1).mines_num == 1


def cost(magnitude, **others):
    register_cost(Cost("cost_mines", (), magnitude, **others))


MINE = disc("mines", "mine")
WRONG = {
    "a built-in element": (lambda: register_element(disc("vases", "jug")), "'vases'.*built-in"),
    "no goal": (lambda: register_task("visit", Task(max, met=max)), "'visit'.*'goal'"),
    "many of a kind": (lambda: register_task("new", Task(max, elements=("vases",))), "'vases_num'"),
    "contacts with nothing": (lambda: cost(max, touches=("pilars",)), "'pilars'.*'pillars'"),
    "a flag that is no key": (
        lambda: register_observation(Reading("x", ("observe_con",), max, max)),
        "no key 'observe_con'.*'observe_com'",
    ),
    "a lidar's flag that is no key": (
        lambda: register_element(replace(MINE, flag="observe_mine"), {"observe_min": False}),
        "no key 'observe_mine'.*'observe_min'",
    ),
    "one object": (lambda: register_element(disc("oil", "oil"), {"oil_num": 2}), "only one object"),
    "no place": (lambda: register_task("a", Task(max, goal_at_button=True)), "add 'goal' to"),
    "a built-in key": (lambda: register_element(MINE, {"num_steps": 3}), "'num_steps'.*taken"),
    "a wrong default": (lambda: register_element(MINE, {"mines_num": "a"}), "mines_num=a"),
}


@pytest.mark.parametrize(("register", "message"), WRONG.values(), ids=WRONG)
def test_wrong_rows_are_refused_and_leave_nothing_behind(register, message):
    known = SafetyGymConfig().to_dict()
    with pytest.raises(ConfigError, match=message):
        register()
    assert SafetyGymConfig().to_dict() == known
    assert SafetyGymEnv(POINT).object_names == ()


def test_names_that_meet_an_observation_are_refused():
    register_observation(Reading("gyro", (), lambda c, s: 1, lambda w: w.up[:, None]))
    with pytest.raises(ConfigError, match=r"Two observations.*'gyro'"):
        SafetyGymEnv(POINT)


EXAMPLE = "examples/custom_environment.py"
MINES = ("env=PointMines", "cost_limits={cost_mines: 10}", "env.mines_num=8")


@pytest.mark.long
def test_the_example_is_trained_resumed_and_evaluated_by_the_ordinary_commands(
    tmp_path, monkeypatch
):
    # with a worker, which has to import it too
    worker = ("collector=process", "collector.num_collectors=1")
    begun = (*MINES, *SMALL, "frames=80", f"hydra.run.dir={tmp_path}")
    in_a_process("train.py", f"import={EXAMPLE}", *begun, *worker)
    assert "estimate_cost_mines" in read_table(tmp_path / "progress.csv")
    monkeypatch.chdir(ROOT)
    resume = (f"resume={tmp_path}", "frames=160")
    assert f"was trained with import={EXAMPLE}: add that to the command" in str(status_of(*resume))
    assert status_of(*resume, f"import={EXAMPLE}") == 0
    assert evaluate([str(tmp_path), "episodes=2", f"import={EXAMPLE}"]) == 0
    assert read_table(tmp_path / "progress.csv")["steps"] == [40, 80, 120, 160]
    assert "cost_mines" in (tmp_path / "evaluation.json").read_text()


@pytest.mark.long
def test_robots_meet_the_mines_of_the_example():
    config = runpy.run_path(str(ROOT / EXAMPLE))["POINT_MINES"]
    env = SafetyGymEnv(config, num_envs=50, seed=0, num_threads=1)
    assert {"mines_lidar", "speed"} <= env.observation_layout.keys()
    rollout = env.rollout(200)
    assert 0 < float((rollout["next", "cost_mines"] > 0).float().mean()) < 0.5
    assert float(rollout["next", "cost_mines"].max()) <= 1.0
