"""Environments with six values: in this process, in one of another Python, and in batches.

The package itself wants another Python; where SAFETY_GYMNASIUM_PYTHON names it, it is tested too.
"""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest
import torch
import yaml
from commands import run_train
from torchrl.envs.utils import check_env_specs

from safe_rl.cli import evaluate, report
from safe_rl.envs import ConfigError, complete_env, make_env
from safe_rl.envs.safety_gymnasium import from_six_values
from safe_rl.runs.table import read_table

STAND_IN = str(Path(__file__).parents[1] / "stand_in")
REAL = os.environ.get("SAFETY_GYMNASIUM_PYTHON")
NODE = {
    "_target_": "safe_rl.envs.safety_gymnasium.make_safety_gymnasium",
    "id": "SafetyIce1-v0",
    "kwargs": {"border": 1.5},
}
SMALL = (
    *("env=safety_gymnasium", "env.id=SafetyIce1-v0", "num_envs=4", "num_threads=1"),
    *(
        "frames_per_batch=80",
        "logger=none",
        "model.hidden_sizes=[8]",
        "cost_limits={cost_right: 3}",
    ),
    *("policy_update.minibatch_size=40", "critic_update.minibatch_size=40"),
)


@pytest.fixture(autouse=True)
def package(monkeypatch):
    """The stand-in, as if it were installed in this Python; none of others is known."""
    monkeypatch.syspath_prepend(STAND_IN)
    monkeypatch.delenv("SAFETY_GYMNASIUM_PYTHON", raising=False)
    yield importlib.import_module("safety_gymnasium")
    for name in [name for name in sys.modules if name.startswith("safety_gymnasium")]:
        del sys.modules[name]


@pytest.fixture
def elsewhere(monkeypatch):
    """The stand-in in another Python: this one, in a process that finds it."""
    monkeypatch.setenv("PYTHONPATH", STAND_IN)
    monkeypatch.setenv("SAFETY_GYMNASIUM_PYTHON", sys.executable)


def rollout(env, steps=40):
    """Random actions, of which the type of the spec would otherwise make other numbers."""
    torch.manual_seed(0)

    def act(tensordict):
        if env.action_spec.dtype == torch.int64:
            return env.rand_action(tensordict)
        return tensordict.set("action", 2.2 * torch.rand(env.action_spec.shape) - 1.1)

    return env.rollout(steps, act, break_when_any_done=False)


def assert_same(first, second):
    """To rounding: one way stretches actions in single precision, the other in double."""
    for key in ("observation", "reward", "cost", "cost_right", "cost_fast"):
        torch.testing.assert_close(first["next", key], second["next", key], rtol=1e-5, atol=1e-5)
    for key in ("terminated", "done"):
        assert (first["next", key] == second["next", key]).all()
    torch.testing.assert_close(first["observation"], second["observation"], rtol=1e-5, atol=1e-5)


def test_a_step_has_its_cost_beside_the_reward():
    env = make_env(NODE, num_envs=5, seed=0)
    assert env.cost_keys == ["cost", "cost_right", "cost_fast"]
    assert env.max_episode_steps == 12
    check_env_specs(env)
    taken = rollout(env)
    place, speed = taken["next", "observation"].split(1, -1)
    torch.testing.assert_close(taken["next", "reward"], speed)
    torch.testing.assert_close(speed, 3 * taken["action"].clamp(-1, 1) + 1)  # from -2 to 4
    torch.testing.assert_close(taken["next", "cost_right"], (place > 0).float())
    torch.testing.assert_close(taken["next", "cost_fast"], speed.abs())
    torch.testing.assert_close(taken["next", "cost"], (place > 0) + speed.abs())
    torch.testing.assert_close(taken["next", "terminated"], place.abs() > 1.5)
    assert 0 < taken["next", "terminated"].sum() < 200


@pytest.mark.parametrize("workers", [0, 2])
def test_another_python_steps_what_this_one_does(workers, elsewhere, monkeypatch):
    served = make_env({**NODE, "workers": workers}, num_envs=5, seed=3)
    check_env_specs(served)
    served.set_seed(3)
    expected = rollout(served)
    processes = [s._process for s in served.base_env._env.env._servers]
    assert len(processes) == max(1, workers)
    served.close()
    assert all(process.poll() == 0 for process in processes)
    monkeypatch.delenv("SAFETY_GYMNASIUM_PYTHON")
    here = make_env(NODE, num_envs=5, seed=3)
    here.set_seed(3)
    assert_same(rollout(here), expected)


def test_modules_are_imported_by_name_of_the_user_only(elsewhere, tmp_path, monkeypatch):
    (tmp_path / "my_ice.py").write_text(
        "import safety_gymnasium\nsafety_gymnasium.KNOWN['SafetyMine-v0'] = safety_gymnasium.Ice\n"
    )
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([STAND_IN, str(tmp_path)]))
    with pytest.raises(ConfigError, match=r"import nothing.*SAFETY_GYMNASIUM_IMPORT=my_ice"):
        complete_env({**NODE, "id": "my_ice:SafetyMine-v0"})
    node = {**NODE, "id": "SafetyMine-v0"}
    with pytest.raises(ConfigError, match="not registered"):
        complete_env(node)
    monkeypatch.setenv("SAFETY_GYMNASIUM_IMPORT", "my_ice")
    assert complete_env(node)["num_steps"] == 12


def test_a_batch_that_begins_by_itself_is_as_one_that_is_asked(package):
    batch = package.vector.make("SafetyIce1-v0", num_envs=4, asynchronous=False, border=1.5)
    eager = from_six_values(batch, num_steps=12, seed=5)
    assert eager.cost_keys == ["cost", "cost_right", "cost_fast"]
    patient = from_six_values(lambda: package.make("SafetyIce1-v0", border=1.5), num_envs=4, seed=5)
    first, second = rollout(eager), rollout(patient)
    assert first["next", "done"].sum() > 8
    assert_same(first, second)
    check_env_specs(eager)


def test_choices_and_dictionaries_become_integers_and_vectors(elsewhere, monkeypatch):
    node = {**NODE, "id": "SafetyButtons0-v0", "kwargs": None, "num_steps": 6}
    served = make_env(node, num_envs=3, seed=0)
    taken = rollout(served, 9)
    assert served.cost_keys == ["cost"]
    torch.testing.assert_close(taken["next", "cost"].squeeze(-1), taken["action"].float())
    seen = taken["next", "observation"]
    torch.testing.assert_close(seen[..., :4].argmax(-1), taken["action"])
    torch.testing.assert_close(seen[..., 4:], torch.ones(3, 9, 2))
    assert taken["next", "truncated"][:, 5].all()
    served.close()
    monkeypatch.delenv("SAFETY_GYMNASIUM_PYTHON")
    torch.testing.assert_close(rollout(make_env(node, num_envs=3, seed=0), 9), taken)


def test_it_is_trained_resumed_evaluated_and_reported(tmp_path, elsewhere, capsys):
    folder = tmp_path / "runs" / "ice"
    run_train(*SMALL, "env.kwargs={border: 1.5}", "frames=160", f"hydra.run.dir={folder}")
    env = yaml.safe_load((folder / "config.yaml").read_text())["env"]
    assert (env["name"], env["num_steps"]) == ("SafetyIce1-v0", 12)
    assert env["cost_keys"] == ["cost", "cost_right", "cost_fast"]
    assert all(cost > 0 for cost in read_table(folder / "progress.csv")["episode_cost_right"])
    run_train(f"resume={folder}", "frames=240")
    assert read_table(folder / "progress.csv")["steps"] == [80, 160, 240]
    assert "The state of its environments is not stored" in capsys.readouterr().out
    assert evaluate.main([str(folder), "episodes=4", "num_envs=2"]) == 0
    assert json.loads((folder / "evaluation.json").read_text())["environment"] == "SafetyIce1-v0"
    assert report.main([str(folder.parent)]) == 0
    assert "SafetyIce1-v0" in (folder.parent / "report" / "report.md").read_text()


def test_pictures_come_from_either_python(elsewhere, monkeypatch):
    node = {**complete_env(NODE), "render_mode": "rgb_array"}
    pictures = []
    for _ in range(2):
        env = make_env(node, num_envs=2, seed=0)
        env.reset()
        pictures.append(env.render(width=60, height=20))
        env.close()
        monkeypatch.delenv("SAFETY_GYMNASIUM_PYTHON", raising=False)
    assert pictures[0].shape == (2, 20, 60, 3)
    assert pictures[0].any()
    assert (pictures[0] == pictures[1]).all()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"id": None}, r"env\.id=Safety"),
        ({"id": "SafetyIce2-v0"}, "SafetyIce2-v0 is not registered"),
        ({"border": 3}, "no key 'border'.*env.kwargs"),
        ({"kwargs": {"speed": 3}}, "SafetyIce1-v0.*speed"),
        ({"workers": -1}, "'workers' must be an integer of at least 0"),
        ({"kwargs": 3}, "'kwargs' must be arguments by name"),
        ({"cost_keys": "cost"}, "'cost_keys' must be a list of names"),
        ({"num_steps": 0}, "'num_steps' must be an integer of at least 1"),
    ],
)
@pytest.mark.parametrize("place", ["here", "elsewhere"])
def test_what_cannot_be_made_is_said(keys, message, place, request):
    if place == "elsewhere":
        request.getfixturevalue("elsewhere")
    with pytest.raises(ConfigError, match=message):
        make_env({**NODE, **keys})


def test_what_to_install_is_said_where_the_package_is_missing(monkeypatch, elsewhere):
    monkeypatch.delenv("PYTHONPATH")
    with pytest.raises(ConfigError, match=r"SAFETY_GYMNASIUM_PYTHON=.*bin/python"):
        make_env(NODE)
    monkeypatch.setenv("SAFETY_GYMNASIUM_PYTHON", "/no/python")
    with pytest.raises(ConfigError, match="/no/python: there is no such program"):
        make_env(NODE)
    monkeypatch.delenv("SAFETY_GYMNASIUM_PYTHON")
    monkeypatch.setitem(sys.modules, "safety_gymnasium", None)
    with pytest.raises(ConfigError, match=r"cannot be imported.*pip install safety-gymnasium"):
        make_env(NODE)


def test_five_values_are_for_the_other_family():
    with pytest.raises(ValueError, match=r"returned 5 values.*env=gymnasium"):
        from_six_values(lambda: gymnasium.make("Pendulum-v1"))


def test_a_process_that_dies_is_told(elsewhere):
    env = make_env(NODE, num_envs=1, seed=0)
    process = env.base_env._env.env._servers[0]._process
    process.kill()
    process.wait()
    with pytest.raises((RuntimeError, BrokenPipeError), match=r"has ended|Broken pipe"):
        env.rollout(3)


def test_signals_pass_over_its_processes(elsewhere):
    """Ctrl-C and what ends a cluster's job reach all; the first one ends its epoch with them."""
    env = make_env(NODE, num_envs=1, seed=0)
    process = env.base_env._env.env._servers[0]._process
    for name in ("INT", "TERM"):
        subprocess.run(["kill", f"-{name}", str(process.pid)], check=True)
    assert env.rollout(3, break_when_any_done=False).shape == (1, 3)
    env.close()
    assert process.wait(300) == 0


@pytest.mark.skipif(REAL is None, reason="SAFETY_GYMNASIUM_PYTHON names a Python with the package")
@pytest.mark.parametrize("name", ["SafetyPointGoal1-v0", "SafetyHopperVelocity-v1"])
def test_the_package_itself(name, monkeypatch):
    monkeypatch.setenv("SAFETY_GYMNASIUM_PYTHON", str(REAL))
    env = make_env({**NODE, "id": name, "kwargs": None}, num_envs=2, seed=0)
    check_env_specs(env)
    taken = rollout(env, 50)
    assert env.max_episode_steps == 1000
    assert taken["next", "reward"].abs().sum() > 0
    env.close()
