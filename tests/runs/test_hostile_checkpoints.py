"""Checkpoints that somebody else has made, or that were changed."""

import shutil

import pytest
import torch
from point_mass_runs import point_mass_trainer
from torchrl.checkpoint import CheckpointError

from safe_rl.evaluation.loading import load_policy
from safe_rl.files import load_tensors, save_tensors
from safe_rl.runs.folder import RunFolder


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two epochs, and the trainer of it."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    trainer = point_mass_trainer(folder, "frames=320")
    trainer.run()
    return folder, trainer


def change(folder, tmp_path, part, edit):
    """A copy of the run, its checkpoints with another state of a part."""
    run = shutil.copytree(folder, tmp_path / "run")
    trainer = point_mass_trainer(run, "frames=480")
    for path in (RunFolder(run).checkpoints / "last").iterdir():
        content = load_tensors(path)
        edit(content["parts"][part])
        save_tensors(path, content)
    return trainer


@pytest.mark.parametrize("steps", ["many", 1e300, -5, 10**20, True])
def test_counters_that_are_none_are_refused(steps, trained, tmp_path):
    trainer = change(trained[0], tmp_path, "progress", lambda state: state.update(steps=steps))
    with pytest.raises(CheckpointError, match="its 'progress' does not fit: 'steps' is"):
        trainer.resume()


@pytest.mark.parametrize("waiting", [{"steps": "many"}, {"epoch": 1e300}, {"states": {}}])
def test_policies_that_are_none_do_not_wait(waiting, trained, tmp_path):
    edit = lambda state: state["waiting"][0].update(waiting)  # noqa: E731
    trainer = change(trained[0], tmp_path, "candidates", edit)
    with pytest.raises(CheckpointError, match="its 'candidates' does not fit: a policy waits"):
        trainer.resume()


@pytest.mark.parametrize("dtype", [torch.int64, torch.complex64, torch.float64])
def test_weights_of_another_kind_are_refused(dtype, trained, tmp_path):
    def edit(state):
        name = next(name for name, value in state.items() if value.is_floating_point())
        state[name] = state[name].to(dtype)

    with pytest.raises(CheckpointError, match=f"is {dtype}, where the network has torch.float32"):
        change(trained[0], tmp_path, "actor", edit).resume()


def test_a_policy_of_nan_is_not_evaluated(trained, tmp_path):
    def edit(state):
        for value in state.values():
            value.fill_(torch.nan)

    trainer = change(trained[0], tmp_path, "actor", edit)
    path = RunFolder(tmp_path / "run").newest_checkpoint()
    config, env = trainer.record._config, trainer._env
    with pytest.raises(CheckpointError, match="weights that are NaN or infinite"):
        load_policy(config, env, path, torch.device("cpu"))
