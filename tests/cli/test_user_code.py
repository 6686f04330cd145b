"""A user's own modules: found, imported when asked for, and never because a run's files say so."""

import sys

import pytest
from omegaconf import OmegaConf
from point_mass import PointMass
from run_configs import point_mass_config

from safe_rl import trust
from safe_rl.cli.composing import read_resumed
from safe_rl.cli.options import split_imports
from safe_rl.envs import complete_env, make_env
from safe_rl.runs.run import Run
from safe_rl.runs.writing import RunWriter
from safe_rl.training.building import build_trainer
from safe_rl.training.train import SETTING_ERRORS
from safe_rl.trust import check_imports, import_modules

MODULE = """
import pathlib
pathlib.Path(__file__).with_suffix(".trace").touch()
class Loss: ...
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder that is the current one, whose modules are forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(trust, "_ROOMS", dict(trust._ROOMS))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_modules_of_a_command_are_split_from_its_words():
    words = ["import=[mine, b/c.py]", "seed=1", "import=mine", "import=it's/x.py"]
    assert split_imports(words) == (["mine", "b/c.py", "it's/x.py"], ["seed=1"])
    assert split_imports(["seed=1"]) == (None, ["seed=1"])
    assert split_imports(["import=[]"]) == ([], [])
    assert split_imports(["import='my folder/x.py'"]) == (["my folder/x.py"], [])  # as Hydra's are


def test_modules_are_found_by_name_and_by_file(folder):
    (folder / "users_first.py").write_text(MODULE)
    (folder / "below").mkdir()
    (folder / "below" / "users_second.py").write_text(MODULE)
    import_modules(["users_first", "below/users_second.py"])
    for name in ("users_first", "users_second"):
        assert trust.locate(f"{name}.Loss") is sys.modules[name].Loss


@pytest.mark.parametrize(
    ("module", "message"),
    [
        ("users_nowhere", "import=users_nowhere: there is no module 'users_nowhere'"),
        ("users_nowhere.py", "import=users_nowhere.py: there is no such file"),
        ("users_broken", r"ZeroDivisionError: .*users_broken.py, line 2\)"),
        ("users_needy", "ModuleNotFoundError: No module named 'users_nowhere'.*line 1"),
        ("users_refused", r"must start with 'cost_'.*users_refused\.py, line 2\)"),
        ("users_unread", r"SyntaxError: '\(' was never closed \(users_unread\.py, line 1\)\.$"),
        ("json.py", "another module of that name"),
        ("json", "another module of that name"),
    ],
)
def test_errors_are_one_line(folder, module, message):
    (folder / "users_broken.py").write_text("x = 1\n1 / 0\n")
    (folder / "users_needy.py").write_text("import users_nowhere\n")
    (folder / "users_refused.py").write_text(
        "from safe_rl.envs.extending import Cost, register_cost\n"
        "register_cost(Cost(key='speed', flags=(), magnitude=max))\n"
    )
    (folder / "users_unread.py").write_text("x = (\n")
    (folder / "json.py").write_text("")
    with pytest.raises(ValueError, match=message) as error:
        import_modules([module])
    assert "\n" not in str(error.value)


GYMNASIUM = "safe_rl.envs.gymnasium.make_gymnasium"


def begun_run(directory, **changes):
    """Folder of a run of somebody else's, with a configuration of theirs."""
    with RunWriter(Run(directory), point_mass_config(), {"cost": 25.0}, 20).writing():
        pass
    path = directory / "config.yaml"
    OmegaConf.save(OmegaConf.merge(OmegaConf.load(path), changes), path)
    return path


def test_opening_a_run_imports_nothing(folder):
    (folder / "users_own.py").write_text(MODULE)
    loss = {"_target_": "users_own.Loss"}
    path = begun_run(folder / "run", **{"import": ["users_own"], "loss": loss})
    with pytest.raises(ValueError, match=r"trained with import=users_own: add that"):
        read_resumed(folder / "run", None, [])
    config = OmegaConf.load(path)
    with pytest.raises(trust.TargetError, match=r"^loss\._target_=users_own\.Loss.*import=users"):
        build_trainer(config, PointMass(config.num_envs, 20), folder / "run")
    assert not (folder / "users_own.trace").exists()
    for given in ([], ["users_own"], ["moved_since.py"], ["/home/o'brien/moved.py"]):
        check_imports(config, given, folder)


@pytest.mark.parametrize(
    ("changes", "act"),
    [
        ({"import": ["$(id)"]}, lambda run: read_resumed(run, None, [])),
        ({}, lambda run: trust.locate("$(id).Loss")),
        ({}, lambda run: complete_env({"_target_": GYMNASIUM, "id": "$(id):Walk-v0"})),
    ],
)
def test_what_is_to_be_copied_into_a_shell_is_quoted(changes, act, folder):
    begun_run(folder / "run", **changes)
    with pytest.raises(ValueError, match=r"'import=\$\(id\)'"):
        act(folder / "run")


def exec_node(trace):
    return {"_target_": "builtins.exec", "_args_": [f"open({str(trace)!r}, 'w')"]}


def test_no_key_of_a_run_leaves_a_trace(folder):
    path = begun_run(folder / "run")
    for key in (
        *("loss", "loss.clip_epsilon", "advantage.gamma", "policy_update.optimizer.lr", "risk"),
        *("cost_advantage.lmbda", "lagrangian.init", "critic_update.optimizer", "collector"),
    ):
        config = OmegaConf.load(path)
        OmegaConf.update(config, key, exec_node(folder / "trace"), force_add=True)
        with pytest.raises(ValueError, match=rf"^{key}\._target_=builtins.exec.*import=builtins"):
            build_trainer(config, PointMass(config.num_envs, 20), folder / "run")
        assert not (folder / "trace").exists()


def test_a_logger_leaves_no_trace(folder):
    config = OmegaConf.load(begun_run(folder / "run", logger=exec_node(folder / "trace")))
    with (
        pytest.raises(ValueError, match=r"^logger\._target_=builtins.exec"),
        RunWriter(Run(folder / "run"), config, {"cost": 25.0}, 20).writing(epoch=0),
    ):
        pass
    assert not (folder / "trace").exists()


def make_without_costs(config, **kind):
    env = PointMass(kind["num_envs"])
    env.cost_keys = ["cost_hazards"]
    return env


def test_what_an_environment_of_ones_own_lacks_is_said(folder):
    trust.allow(__name__)
    node = {"_target_": f"{__name__}.make_without_costs", "name": "mine"}
    with pytest.raises(SETTING_ERRORS) as error:
        make_env(node, num_envs=2)
    assert "PointMass is no constrained environment:\n- 'cost_keys' must be" in str(error.value)
