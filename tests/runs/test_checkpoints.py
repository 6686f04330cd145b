"""Checkpoints: rotation, the best one, and files that are not what they should be."""

import zipfile

import pytest
import torch
from torch import nn
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from safe_rl.runs.checkpoints import CheckpointStore


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
    assert [path.name[-10:] for path in store.last.checkpoints()] == ["20.torchrl", "30.torchrl"]
    restored = parts(7)
    CheckpointStore.load(store.last.latest(), restored)
    assert restored["counter"].value == 30
    assert torch.equal(restored["network"].weight, components["network"].weight)
    assert Checkpoint.manifest(store.last.latest())["metadata"] == {"epoch": 3}


def test_the_best_one_is_replaced_only_by_a_better_one(tmp_path):
    components = parts(1)
    store = CheckpointStore(tmp_path, components, keep_last=1)
    written = []
    for steps, score in ((1, -5.0), (2, -7.0), (3, 2.0), (4, 2.0), (5, 1.0)):
        components["counter"].value = steps
        written.append(store.save_best(steps, score))
    assert written == [True, False, True, False, False]
    assert len(store.best.checkpoints()) == 1
    restored = parts(0)
    CheckpointStore.load(store.best.latest(), restored)
    assert restored["counter"].value == 3


def test_a_part_can_be_restored_alone(tmp_path):
    store = CheckpointStore(tmp_path, parts(1), keep_last=1)
    counter = Counter()
    CheckpointStore.load(store.save(10), {"counter": counter})
    assert counter.value == 1


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
    def __reduce__(self):
        return open, ("harm.txt", "w")


def test_loading_runs_no_code_of_the_checkpoint(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    component = Counter(Harmful())
    checkpoint = Checkpoint(format="archive")
    checkpoint.register(
        "counter", component, adapter=StateDictCheckpointAdapter(payload_format="torch")
    )
    path = checkpoint.save(tmp_path / "harmful.torchrl")
    assert zipfile.is_zipfile(path)
    with pytest.raises(CheckpointError, match="counter"):
        CheckpointStore.load(path, {"counter": Counter()})
    assert not (tmp_path / "harm.txt").exists()
