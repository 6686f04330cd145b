"""Checkpoints that somebody else has made, or that were changed."""

import shutil

import pytest
import torch
from point_mass_runs import point_mass_trainer
from torchrl.checkpoint import CheckpointError

from safe_rl.evaluation.loading import load_policy
from safe_rl.files import load_tensors, save_tensors
from safe_rl.runs.run import Run


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
    for path in (Run(run).checkpoints_folder / "last").iterdir():
        content = load_tensors(path)
        edit(content["parts"][part])
        save_tensors(path, content)
    return trainer


def test_counters_that_are_none_are_refused(trained, tmp_path):
    trainer = change(trained[0], tmp_path, "progress", lambda state: state.update(steps="many"))
    with pytest.raises(CheckpointError, match="its 'progress' does not fit: there is"):
        trainer.resume()


def test_a_policy_of_nan_is_not_evaluated(trained, tmp_path):
    def edit(state):
        for value in state.values():
            value.fill_(torch.nan)

    trainer = change(trained[0], tmp_path, "actor", edit)
    path = Run(tmp_path / "run").newest_checkpoint()
    config, env = trainer.writer._config, trainer._env
    with pytest.raises(CheckpointError, match="weights that are NaN or infinite"):
        load_policy(config, env, path, torch.device("cpu"))
