"""Checkpoints: rotation, the best one, and files that are not what they should be."""

import copy
import errno
import json
import zipfile

import pytest
import tensordict
import torch
from tensordict import NonTensorData, TensorDict
from torch import nn
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from safe_rl.runs.checkpoint_file import read_facts, writer
from safe_rl.runs.checkpoints import CheckpointStore, best_checkpoint
from safe_rl.runs.folder import checkpoint_steps, checkpoints_in


class Counter:
    def __init__(self, value=0):
        self.value = value

    def state_dict(self):
        return {"value": self.value}

    def load_state_dict(self, state_dict):
        self.value = state_dict["value"]


def parts(value):
    network = nn.Linear(3, 2)
    nn.init.constant_(network.weight, value)
    return {"network": network, "counter": Counter(value)}


def test_the_newest_are_kept_and_restored(tmp_path):
    components = parts(1)
    store = CheckpointStore(tmp_path, components, keep_last=2)
    for steps in (10, 20, 30):
        components["counter"].value = steps
        store.save(steps, {"epoch": steps // 10})
    *older, newest = checkpoints_in(store.last)
    assert [path.name[-10:] for path in (*older, newest)] == ["20.torchrl", "30.torchrl"]
    restored = parts(7)
    CheckpointStore.load(newest, restored)
    assert restored["counter"].value == 30
    assert torch.equal(restored["network"].weight, components["network"].weight)
    assert read_facts(newest) == {"epoch": 3}


def test_the_best_one_is_replaced_only_by_a_better_one(tmp_path):
    components = parts(1)
    store = CheckpointStore(tmp_path, components, keep_last=1)
    written = []
    for steps, score in ((1, -5.0), (2, -7.0), (3, 2.0), (4, 2.0), (5, 1.0)):
        components["counter"].value = steps
        written.append(store.save_best(steps, score))
    assert written == [True, False, True, False, False]
    (best,) = checkpoints_in(store.best)
    restored = parts(0)
    CheckpointStore.load(best, restored)
    assert restored["counter"].value == 3


def test_several_best_ones_are_those_with_the_highest_scores(tmp_path):
    store = CheckpointStore(tmp_path, parts(1), keep_last=1, keep_best=2)
    scores = ((1, 3.0), (2, 9.0), (3, 5.0), (4, 4.0), (5, 9.0), (6, 9.0))
    assert [store.save_best(*one) for one in scores] == [True, True, True, False, True, False]
    assert [checkpoint_steps(path) for path in checkpoints_in(store.best)] == [2, 5]
    assert checkpoint_steps(best_checkpoint(store.best)) == 5
    (store.best / "checkpoint-000000000001.torchrl").write_text("damaged")
    assert checkpoint_steps(best_checkpoint(store.best)) == 1
    assert best_checkpoint(tmp_path / "none") is None


def test_a_best_one_that_was_displaced_is_the_best_again_after_resuming_from_before(tmp_path):
    store = CheckpointStore(tmp_path, parts(1), keep_last=1)
    assert store.save_best(1, 5.0)
    store.save(2)
    for steps, score in ((3, 6.0), (4, 7.0)):
        assert store.save_best(steps, score)
    assert [checkpoint_steps(path) for path in checkpoints_in(store.best)] == [1, 4]
    assert checkpoint_steps(best_checkpoint(store.best)) == 4
    again = CheckpointStore(tmp_path, parts(1), keep_last=1)
    assert again.resume()
    assert [checkpoint_steps(path) for path in checkpoints_in(store.best)] == [1]
    assert again.save_best(4, 7.0)
    again.save(4)
    assert [checkpoint_steps(path) for path in checkpoints_in(store.best)] == [4]


@pytest.mark.parametrize("damage", ["truncated", "flipped", "text", "missing"])
def test_a_damaged_file_is_refused_and_touches_nothing(tmp_path, damage):
    path = CheckpointStore(tmp_path, parts(1), keep_last=1).save(10)
    content = bytearray(path.read_bytes())
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        # a byte of the weights: 1.0 as little-endian float32, wherever the archive keeps it
        content[content.index(b"\x00\x00\x80\x3f" * 6) + 2] ^= 1
        path.write_bytes(content)
    elif damage == "text":
        path.write_text("no checkpoint")
    else:
        path.unlink()
    target = parts(7)
    with pytest.raises(CheckpointError, match=path.name):
        CheckpointStore.load(path, target)
    assert target["counter"].value == 7
    assert (target["network"].weight == 7).all()


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    path = CheckpointStore(tmp_path, parts(1), keep_last=1).save(10)
    with pytest.raises(CheckpointError, match="multiplier"):
        CheckpointStore.load(path, {**parts(7), "multiplier": Counter()})
    with pytest.raises(CheckpointError, match="size mismatch"):
        CheckpointStore.load(path, {"network": nn.Linear(4, 2)})


class Harmful:
    """Opens a file when it is unpickled."""

    def __init__(self, trace):
        self.trace = str(trace)

    def __reduce__(self):
        return open, (self.trace, "w")


def write_checkpoint(path, component, adapter, container="archive"):
    """A checkpoint with one part, written by TorchRL as it may be by somebody else."""
    checkpoint = Checkpoint(format=container)
    checkpoint.register("counter", component, adapter=adapter)
    return checkpoint.save(path)


def refuse(path, match, trace):
    target = Counter(7)
    with pytest.raises(CheckpointError, match=match):
        CheckpointStore.load(path, {"counter": target})
    assert target.value == 7
    assert not trace.exists()


def test_loading_runs_no_code_of_the_weights_file(tmp_path):
    trace = tmp_path / "trace.txt"
    adapter = StateDictCheckpointAdapter(payload_format="torch")
    path = write_checkpoint(tmp_path / "a.torchrl", Counter(Harmful(trace)), adapter)
    assert zipfile.is_zipfile(path)
    refuse(path, "more than tensors", trace)


@pytest.mark.parametrize("payload", ["directory", "archive", "consolidated"])
@pytest.mark.parametrize("container", ["archive", "directory"])
def test_other_payloads_are_refused_before_they_are_read(tmp_path, payload, container):
    trace = tmp_path / "trace.txt"
    adapter = StateDictCheckpointAdapter(payload_format=payload)
    written = tmp_path / "written"
    write_checkpoint(written, Counter(torch.ones(2)), adapter, "directory")
    state = written / "components" / "0000-counter" / "state"
    if payload == "directory":
        # what a TensorDict cannot keep as tensors it keeps, and loads, as a pickle
        harmful = TensorDict(tensor_00000000=torch.ones(2), a=NonTensorData(Harmful(trace)))
        tensordict.save(harmful, state)
    path = written if container == "directory" else zipped(written, tmp_path / "a.torchrl")
    refuse(path, "only state.pt" if container == "archive" else "one file", trace)
    if payload == "directory":
        # what was refused is harmful indeed
        stock = StateDictCheckpointAdapter()
        options = {"map_location": None, "tensor_load_kwargs": {}, "args": (), "kwargs": {}}
        with pytest.warns(FutureWarning, match="pickled"):
            stock.load(Counter(), state.parent, **options)
        assert trace.exists()


def zipped(folder, path):
    """A checkpoint in a folder as an archive, with every file of the folder in its inventory."""
    manifest = json.loads((folder / "manifest.json").read_text())
    part = folder / "components" / "0000-counter"
    files = [file.relative_to(part).as_posix() for file in part.rglob("*") if file.is_file()]
    manifest["components"]["counter"]["files"] = files
    return rewritten(path, manifest, {f"components/0000-counter/{f}": part / f for f in files})


def rewritten(path, manifest, members):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("manifest.json", json.dumps(manifest))
        for name, source in members.items():
            archive.writestr(name, source.read_bytes())
    return path


def test_a_pickle_beside_the_weights_is_refused(tmp_path):
    folder = tmp_path / "written"
    adapter = StateDictCheckpointAdapter(payload_format="torch")
    write_checkpoint(folder, Counter(1), adapter, "directory")
    (folder / "components" / "0000-counter" / "state.json").write_text("{}")
    refuse(zipped(folder, tmp_path / "a.torchrl"), "only state.pt", tmp_path / "trace.txt")


@pytest.mark.parametrize(
    "record",
    [
        {"path": "../outside"},
        {"path": "/tmp"},
        {"files": ["../../state.pt"]},
        {"files": ["state.pt", "../../../trace.txt"]},
        {"files": []},
        {"files": "state.pt"},
        {"adapter": "torchrl.dump_load"},
    ],
)
def test_a_manifest_cannot_point_elsewhere(tmp_path, record):
    whole = CheckpointStore(tmp_path, {"counter": Counter(1)}, keep_last=1).save(10)
    manifest = Checkpoint.manifest(whole)
    manifest["components"]["counter"].update(record)
    state = tmp_path / "state.pt"
    torch.save({"value": 3}, state)
    path = rewritten(
        tmp_path / "a.torchrl",
        manifest,
        dict.fromkeys(["components/0000-counter/state.pt", "trace.txt", "../trace.txt"], state),
    )
    refuse(path, "Cannot use the checkpoint .*a.torchrl", tmp_path / "trace.txt")


def test_a_link_in_place_of_the_weights_is_refused(tmp_path):
    part = tmp_path / "part"
    part.mkdir()
    torch.save({"value": 3}, tmp_path / "elsewhere.pt")
    (part / "state.pt").symlink_to(tmp_path / "elsewhere.pt")
    counter = Counter(7)
    with pytest.raises(CheckpointError, match=r"state\.pt is no file"):
        writer({"counter": counter})._components["counter"].adapter.load(counter, part)
    assert counter.value == 7


@pytest.mark.parametrize("manifest", ["[]", "null", "{", "", '{"format": 3}', "[" * 100_000])
def test_a_manifest_that_is_none_is_refused_and_stops_no_run(tmp_path, manifest):
    store = CheckpointStore(tmp_path, {"counter": Counter(1)}, keep_last=2)
    store.save_best(10, 1.0)
    store.save(10)
    for folder in (store.last, store.best):
        with zipfile.ZipFile(folder / "checkpoint-000000000020.torchrl", "w") as archive:
            archive.writestr("manifest.json", manifest)
    refuse(store.last / "checkpoint-000000000020.torchrl", "Cannot use", tmp_path / "trace.txt")
    with pytest.warns(UserWarning, match="Continuing from the older"):
        assert store.resume().name == "checkpoint-000000000010.torchrl"
    store.save(20)
    assert not store.save_best(20, 0.5)


def test_a_checkpoint_of_another_seed_is_not_resumed_from(tmp_path):
    counter = Counter(1)
    path = CheckpointStore(tmp_path, {"counter": counter}, keep_last=1, run={"seed": 3}).save(10)
    other = CheckpointStore(tmp_path, {"counter": counter}, keep_last=1, run={"seed": 0})
    with pytest.raises(CheckpointError, match=r"its seed is 3, this run's is 0\..*init_from="):
        other.resume()
    # its networks may be read all the same, and so may checkpoints that say nothing of it
    CheckpointStore.load(path, {"counter": counter})
    CheckpointStore(tmp_path, {"counter": counter}, keep_last=1).save(20)
    assert other.resume().name.endswith("20.torchrl")


def test_what_a_killed_run_has_begun_is_cleared_and_what_it_put_aside_restored(tmp_path):
    store = CheckpointStore(tmp_path, {"counter": Counter(1)}, keep_last=3)
    for steps in (10, 20):
        store.save(steps)
    store.save_best(10, 0.0)
    name = "checkpoint-000000000020.torchrl"
    (store.last / name).rename(store.last / f".{name}.backup-0a")
    for folder in (store.last, store.best):
        (folder / ".checkpoint-000000000030.torchrl.archive-0a").write_text("begun")
        (folder / ".checkpoint-000000000030.torchrl.stage-0a").mkdir()
        (folder / ".checkpoint-000000000010.torchrl.backup-0a").write_text("replaced")
    assert store.resume().name == name
    left = [path.name[-10:] for path in sorted(store.last.iterdir())]
    assert left == ["10.torchrl", "20.torchrl"]
    assert len(list(store.best.iterdir())) == 1


def test_a_full_disk_leaves_the_checkpoints_that_were_there(tmp_path, monkeypatch):
    counter = Counter(1)
    store = CheckpointStore(tmp_path, {"counter": counter}, keep_last=1)
    store.save(10)

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "write", full)
        counter.value = 2
        with pytest.raises(OSError, match="No space"):
            store.save(20)
    assert [path.name for path in store.last.iterdir()] == ["checkpoint-000000000010.torchrl"]
    store.resume()
    assert counter.value == 1


def test_the_best_can_be_one_of_before(tmp_path):
    components = parts(1)
    store = CheckpointStore(tmp_path, components, keep_last=1)
    states = {name: copy.deepcopy(part.state_dict()) for name, part in components.items()}
    components["counter"].value = 2
    assert store.save_best(10, 1.0, states=states)
    restored = parts(0)
    CheckpointStore.load(best_checkpoint(store.best), restored)
    assert restored["counter"].value == 1
