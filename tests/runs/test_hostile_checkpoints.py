"""Checkpoints that somebody else has made, or that were changed."""

import shutil
import zipfile

import pytest
import torch
from point_mass_runs import point_mass_trainer
from torchrl.checkpoint import CheckpointError

from safe_rl.evaluation.loading import load_policy
from safe_rl.runs.checkpoint_file import as_parts, read_states, writer
from safe_rl.runs.folder import RunFolder

PARTS = ("actor", "progress", "candidates")


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
        states = read_states(path, trainer.components().keys())
        edit(states[part])
        path.unlink()
        writer(as_parts(states)).save(path, metadata={"epoch": 2})
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


def copied(folder, place, actor=None, compression=zipfile.ZIP_STORED):
    """The newest checkpoint written once more, compressed or with another file for the actor."""
    path = RunFolder(folder).newest_checkpoint()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(place / path.name, "w", compression) as new:
        for name in old.namelist():
            is_replaced = actor is not None and "actor" in name
            new.writestr(name, actor.read_bytes() if is_replaced else old.read(name))
    return place / path.name


def test_compressed_checkpoints_and_parts_are_refused_before_they_fill_the_memory(
    trained, tmp_path
):
    with zipfile.ZipFile(tmp_path / "inner.pt", "w", zipfile.ZIP_DEFLATED) as part:
        part.writestr("archive/data/0", bytes(10**6))
    for options in ({"compression": zipfile.ZIP_DEFLATED}, {"actor": tmp_path / "inner.pt"}):
        with pytest.raises(CheckpointError, match="compressed parts"):
            read_states(copied(trained[0], tmp_path, **options), PARTS)


def test_a_pickle_is_refused_in_a_line_without_advice(trained, tmp_path):
    torch.save({"weight": Touching()}, tmp_path / "state.pt")
    with pytest.raises(CheckpointError) as caught:
        read_states(copied(trained[0], tmp_path, tmp_path / "state.pt"), PARTS)
    assert "\n" not in str(caught.value)
    assert "weights_only" not in str(caught.value)


class Touching:
    """What only code could read."""


def test_a_disk_that_is_full_is_an_error_of_the_system(trained, monkeypatch):
    def fail(*arguments, **options):
        raise RuntimeError("basic_ios::clear: iostream error\nand more")

    monkeypatch.setattr("torchrl.checkpoint.Checkpoint.save", fail)
    with pytest.raises(OSError, match="is the disk full") as caught:
        trained[1]._checkpoints.save(320)
    assert "\n" not in str(caught.value)
