"""Checkpoints that somebody else has made, or that were changed."""

import math
import shutil

import pytest
import torch
from point_mass_runs import point_mass_trainer, trainer_of
from run_configs import off_policy_config
from torchrl.checkpoint import CheckpointError

from safe_rl.evaluation.loading import load_policy
from safe_rl.files import load_tensors, save_tensors
from safe_rl.runs.checkpoints import CheckpointStore
from safe_rl.runs.run import Run


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two epochs, and the trainer of it."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    trainer = point_mass_trainer(folder, "frames=320")
    trainer.run()
    return folder, trainer


def edited(folder, tmp_path, part, edit):
    """A copy of a run, its checkpoints with another state of a part."""
    run = shutil.copytree(folder, tmp_path / "run")
    for path in (Run(run).checkpoints_folder / "last").iterdir():
        content = load_tensors(path)
        edit(content["parts"][part])
        save_tensors(path, content)
    return run


@pytest.fixture(scope="module")
def off_policy(tmp_path_factory):
    """A run with a replay buffer of transitions over three steps, and the trainer of it."""
    folder = tmp_path_factory.mktemp("off_policy") / "run"
    config = off_policy_config("algo=sac_lagrangian", "memory.n_steps=3", "frames=320")
    trainer = trainer_of(config, folder)
    trainer.run()
    return folder, trainer


def load_edited(trained, *edit):
    """What resuming does with it, in the trainer that there is."""
    folder, trainer = trained
    path = Run(edited(folder, *edit)).newest_checkpoint()
    CheckpointStore.load(path, trainer.components)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (
            lambda s: s["steps"].update(observation=torch.ones(308, 3)),
            r"'observation' is .* \[308, 3\], .* \[308, 4\]",
        ),
        (
            lambda s: s["steps"].update({"next/reward": torch.ones(308, 1).long()}),
            "'next/reward' is torch.int64",
        ),
        (lambda s: s["steps"].update(action=torch.ones(9, 2)), r"'action' is .* \[9, 2\]"),
        (lambda s: s["steps"].update(action=[1.0]), r"'action' is .* \[1\]"),
        (lambda s: s["steps"].pop("next/cost"), "there is no 'next/cost'"),
        (lambda s: s["steps"].pop("steps_to_next_obs"), "there is no 'steps_to_next_obs"),
        (lambda s: s.update(size=10**9), "are too many"),
        (lambda s: s["writer"].update(_cursor=-1), "308 transitions, the next at -1"),
        (lambda s: s["tail"].update(action=torch.ones(4, 3, 1)), r"'action' is .* \[4, 3, 1\]"),
        (
            lambda s: s.update(tail={k: v[:2] for k, v in s["tail"].items()}, tail_shape=[2, 3]),
            r"\[2, 3, .\], .* \[4, 3, .\]",
        ),
    ],
)
def test_transitions_of_another_kind_are_refused_in_a_line(edit, words, off_policy, tmp_path):
    match = f"checkpoint-000000000320.torchrl: its 'memory' does not fit: .*{words}"
    with pytest.raises(CheckpointError, match=match) as caught:
        load_edited(off_policy, tmp_path, "memory", edit)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("part", "edit", "words"),
    [
        ("progress", dict.clear, "there is no 'epoch'"),
        ("accounting", lambda state: state["totals"].fill_(math.nan), "must be finite"),
        ("accounting", lambda state: state["totals"].neg_(), "not below 0"),
        ("accounting", lambda state: state["open_sums"][:, 0].fill_(-3), "not below 0"),
        ("accounting", lambda state: state.update(totals=[1.0]), "'totals' is a list"),
        ("accounting", lambda state: state.update(open_sums=torch.ones(9, 3)), "of the shape"),
        ("policy_update", lambda state: state.update(optimizer=[]), ""),
        ("algorithm", lambda state: state.update(tracker=[]), "there is no 'costs'"),
        ("actor", lambda state: state.update({"\x1b[31m": torch.ones(1)}), r"\?\[31m"),
    ],
)
def test_a_part_of_another_kind_is_refused_in_a_line(part, edit, words, trained, tmp_path):
    with pytest.raises(CheckpointError, match=f"its '{part}' does not fit: .*{words}") as caught:
        load_edited(trained, tmp_path, part, edit)
    assert str(caught.value).isprintable()


def test_a_policy_of_nan_is_not_evaluated(trained, tmp_path):
    def edit(state):
        for value in state.values():
            value.fill_(torch.nan)

    path = Run(edited(trained[0], tmp_path, "actor", edit)).newest_checkpoint()
    config, env = trained[1].writer.config, trained[1].env
    with pytest.raises(CheckpointError, match="weights that are NaN or infinite"):
        load_policy(config, env, path, torch.device("cpu"))
