"""Checkpoints that somebody else has made, or that were changed."""

import math
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


def moments(state):
    return state["optimizer"]["state"][0]


@pytest.mark.parametrize(
    ("part", "edit", "words"),
    [
        ("progress", lambda state: state.update(steps="many"), "'steps' is 'many'"),
        ("progress", lambda state: state.update(steps=-1), "not below 0"),
        ("progress", lambda state: state.update(seconds=math.nan), "must be finite"),
        ("progress", dict.clear, "there is no 'epoch'"),
        ("accounting", lambda state: state["totals"].fill_(math.nan), "must be finite"),
        ("accounting", lambda state: state["totals"].neg_(), "not below 0"),
        ("accounting", lambda state: state["open_sums"][:, 0].fill_(-3), "not below 0"),
        ("accounting", lambda state: state.update(totals=[1.0]), "'totals' is a list"),
        ("accounting", lambda state: state.update(open_sums=torch.ones(9, 3)), "of the shape"),
        ("policy_update", lambda state: state.update(optimizer=[]), ""),
        ("policy_update", lambda state: moments(state).update(exp_avg=torch.ones(9)), "'exp_avg'"),
        ("candidates", lambda state: state.update(waiting=[3]), "a waiting policy must"),
        ("candidates", lambda state: state.update(waiting={}), "'waiting' is"),
        ("algorithm", lambda state: state.update(tracker=[]), "there is no 'costs'"),
        ("actor", lambda state: state.update({"\x1b[31m": torch.ones(1)}), r"\?\[31m"),
    ],
)
def test_a_part_of_another_kind_is_refused_in_a_line(part, edit, words, trained, tmp_path):
    trainer = change(trained[0], tmp_path, part, edit)
    with pytest.raises(CheckpointError, match=f"its '{part}' does not fit: .*{words}") as caught:
        trainer.resume()
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("content", [[], {"facts": [], "parts": {}}, {"facts": {}, "parts": []}])
def test_what_is_no_checkpoint_is_refused_with_its_file(content, trained, tmp_path):
    run = shutil.copytree(trained[0], tmp_path / "run")
    trainer = point_mass_trainer(run, "frames=480")
    for path in (Run(run).checkpoints_folder / "last").iterdir():
        save_tensors(path, content)
    with pytest.raises(CheckpointError, match=r"Cannot use the checkpoint .*torchrl: "):
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
