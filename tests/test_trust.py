"""What a configuration may build, what it may not, and what it says then."""

import sys
from functools import partial
from types import ModuleType

import pytest
import torch
from omegaconf import OmegaConf

from safe_rl import trust
from safe_rl.algorithms import MinibatchUpdate
from safe_rl.checks import SettingError
from safe_rl.trust import TargetError, instantiate, locate

ADAM = {"_target_": "torch.optim.Adam", "_partial_": True, "lr": 0.1}


@pytest.fixture
def users(monkeypatch):
    """A module of the user's, which borrows things from others."""
    module = ModuleType("users_module")
    exec(
        "import os, pickle\n"
        "from os import system\n"
        "class Loss:\n"
        "    def __init__(self, weight, **others):\n"
        "        self.weight, self.others = weight, others\n"
        "NUMBER = 3\n",
        module.__dict__,
    )
    monkeypatch.setitem(sys.modules, "users_module", module)
    monkeypatch.setattr(trust, "_ROOMS", dict(trust._ROOMS))
    return module


def test_live_objects_are_not_copied_and_nested_nodes_are_built():
    loss = torch.nn.Linear(1, 1)
    node = {"_target_": "safe_rl.algorithms.MinibatchUpdate", "num_passes": 1, "minibatch_size": 4}
    node |= {"compile": False, "optimizer": ADAM | {"lr": "${rate}"}}
    config = OmegaConf.create({"rate": 0.25, "policy_update": node})
    update = instantiate(config.policy_update, loss=loss)
    assert isinstance(update, MinibatchUpdate)
    assert update.loss is loss
    assert update.optimizer.param_groups[0]["params"][0] is loss.weight
    assert update.optimizer.param_groups[0]["lr"] == 0.25


def test_a_null_target_is_nothing_and_a_missing_one_an_error():
    assert instantiate(None) is None
    assert instantiate(OmegaConf.create({"logger": {"_target_": None}}).logger) is None
    with pytest.raises(TargetError, match=r"^loss\._target_ is missing"):
        instantiate(OmegaConf.create({"loss": {"clip_epsilon": 0.2}}).loss)
    with pytest.raises(TargetError, match=r"^_target_ is missing"):
        instantiate(3)
    with pytest.raises(TargetError, match=r"^loss\._target_ has to be given: loss\._target_=…$"):
        instantiate(OmegaConf.create({"loss": {"_target_": "???"}}).loss)


def test_an_unknown_argument_of_an_item_of_a_list_is_named():
    rate = {"_target_": "safe_rl.algorithms.KLAdaptiveRate", "widht": 1}
    node = {"_target_": "torch.optim.Adam", "params": [rate]}
    with pytest.raises(SettingError, match=r"^params0: .*unexpected keyword argument 'widht'"):
        instantiate(node)


def test_partial_nodes_wait_for_their_arguments():
    waiting = instantiate(ADAM)
    assert isinstance(waiting, partial)
    assert waiting([torch.nn.Parameter(torch.zeros(1))]).defaults["lr"] == 0.1


@pytest.mark.parametrize(
    "name",
    [
        *("torch.load", "os.system", "builtins.eval", "builtins.exec", "eval", "posix.system"),
        *("subprocess.run", "pickle.loads", "importlib.import_module", "hydra.utils.instantiate"),
        # commands, and what imports modules or writes files
        *("safe_rl.extras.import_extra", "safe_rl.trust.allow", "safe_rl.cli.train.main"),
        *("safe_rl.runs.run.Run", "safe_rl.reporting.write_report"),
        # by way of what an allowed module has imported
        *("safe_rl.cli.os.system", "safe_rl.collectors.workers.torch.load"),
        *("safe_rl.collectors.workers.signal.raise_signal", "safe_rl.runs.loggers.Path"),
        *("safe_rl.collectors.workers.partial", "safe_rl.collectors.workers.Thread"),
        *("safe_rl.algorithms.minibatch.torch.load", "torch.optim.adam.torch.load"),
        *("torch.optim.lr_scheduler.partial", "torch.optim.adam.Tensor"),
        *("safe_rl.runs.loggers.Path.unlink", "safe_rl.runs.loggers.import_extra"),
        # parts of the package that start programs, import modules, write files and remove them
        *("safe_rl.envs.gymnasium.CheckedSteps", "safe_rl.envs.from_gymnasium"),
        *("safe_rl.collectors.StepRecorder", "safe_rl.collectors.recording.Recording"),
        "safe_rl.envs.gymnasium.from_gymnasium",
        "safe_rl.algorithms.dataset.read_dataset",
        # what classes have of others
        *("safe_rl.objectives.PPOLoss.load_state_dict", "safe_rl.objectives.PPOLoss.__class__"),
        *("safe_rl.objectives.policy_losses.__builtins__.eval", "safe_rl.objectives.PPOLoss.mro"),
        *("safe_rl.objectives", "safe_rl", "torch.optim", "torch.optim.adam", "", ".", "..os"),
        *(3, True, "safe_rl.objectivesx.y", "safe_rl.envs..os", "torch.optimx.Adam"),
    ],
)  # fmt: skip
def test_nothing_else_is_reached(name):
    with pytest.raises(TargetError):
        locate(name, "loss._target_")


def test_what_the_package_keeps_to_itself_is_reached_where_the_user_names_its_module(monkeypatch):
    monkeypatch.setitem(trust._ROOMS, "safe_rl.collectors.recording", None)
    assert locate("safe_rl.collectors.recording.Recording").__name__ == "Recording"
    with pytest.raises(
        TargetError, match=r"only make_gymnasium, .*\. Did you mean 'make_gymnasium'"
    ):
        locate("safe_rl.envs.gymnasium.make_gym")


def traces(path, name):
    """Nodes of which each, if built, would leave a file."""
    write = f"import pathlib; pathlib.Path({str(path)!r}).touch()"
    return {
        "outermost": {"_target_": "builtins.exec", "_args_": [write]},
        "argument": ADAM | {"lr": {"_target_": "builtins.exec", "_args_": [write]}},
        "list": {"_target_": name, "weight": [{"a": {"_target_": "os.system", "command": write}}]},
        "deep": {"_target_": name, "weight": {"a": {"b": {"_target_": "pathlib.Path.touch",
                                                         "_args_": [str(path)]}}}},
        "positional": {"_target_": name, "_args_": [{"_target_": "builtins.open",
                                                     "_args_": [str(path), "w"]}]},
        "not recursive": {"_target_": name, "_recursive_": False,
                          "weight": {"_target_": "builtins.open", "_args_": [str(path), "w"]}},
    }  # fmt: skip


@pytest.mark.parametrize("which", traces("", ""))
def test_no_node_leaves_a_trace(tmp_path, users, which):
    trust.allow("users_module")
    trace = tmp_path / "trace"
    node = traces(trace, "users_module.Loss")[which]
    with pytest.raises(TargetError, match=r"^part\..*_target_="):
        instantiate(OmegaConf.create({"part": node}).part)
    with pytest.raises(TargetError, match="_target_="):
        instantiate(node)
    assert not trace.exists()


def test_a_target_is_checked_after_its_interpolations(tmp_path, monkeypatch):
    monkeypatch.setenv("SAFE_RL_TEST_TARGET", "os.getcwd")
    config = OmegaConf.create({"loss": {"_target_": "${oc.env:SAFE_RL_TEST_TARGET}"}})
    with pytest.raises(TargetError, match=r"loss\._target_=os\.getcwd.*import=os "):
        instantiate(config.loss)


def test_modules_are_not_imported_to_be_refused(tmp_path, monkeypatch):
    (tmp_path / "strange_module.py").write_text(
        "import pathlib; pathlib.Path(__file__).with_name('trace').touch()\nclass Loss: ..."
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(TargetError, match=r"add import=strange_module to the command \(in Python"):
        instantiate({"_target_": "strange_module.Loss"})
    assert not (tmp_path / "trace").exists()


def test_modules_named_by_the_user_are_reached_but_not_what_they_borrow(users):
    with pytest.raises(TargetError, match="add import=users_module to the command"):
        instantiate({"_target_": "users_module.Loss", "weight": 2})
    trust.allow("users_module")
    loss = instantiate({"_target_": "users_module.Loss", "weight": 2}, network="n")
    assert (loss.weight, loss.others) == (2, {"network": "n"})
    for name in ("os.system", "system", "pickle.loads", "NUMBER", "Loss.__init__"):
        with pytest.raises(TargetError):
            locate(f"users_module.{name}")
    with pytest.raises(
        TargetError, match=r"'users_module' has no attribute 'Lose'\. Did you mean 'Loss'"
    ):
        locate("users_module.Lose")
