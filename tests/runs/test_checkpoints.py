"""Checkpoints: rotation, the best one, and files that are not what they should be."""

import copy
import zipfile

import pytest
import torch
from torch import nn
from torchrl.checkpoint import CheckpointError

from safe_rl.runs.checkpoints import (
    CheckpointStore,
    best_checkpoint,
    check_interface,
    hold,
    is_finished,
    policy_hash,
    read_states,
)
from safe_rl.runs.folder import checkpoint_steps, checkpoints_in
from safe_rl.training.state import Progress


def parts(value):
    network = nn.Linear(3, 2)
    nn.init.constant_(network.weight, value)
    return {"network": network, "counter": Progress(value)}


def steps_in(folder):
    return [checkpoint_steps(path) for path in checkpoints_in(folder)]


def test_as_many_of_the_last_ones_are_kept_as_are_asked_for(tmp_path):
    store = CheckpointStore(tmp_path, parts(1), keep_last=2)
    for steps in (10, 20, 30):
        store.save(steps)
    assert steps_in(store.last) == [20, 30]
    # what has just been written stays, even if another one counts more steps
    alone = CheckpointStore(tmp_path, parts(1), keep_last=1)
    assert alone.save(25).exists()
    assert steps_in(store.last) == [25]


def test_several_best_ones_are_those_with_the_highest_scores(tmp_path):
    store = CheckpointStore(tmp_path, parts(1), keep_last=1, keep_best=2)
    scores = ((1, 3.0), (2, 9.0), (3, 5.0), (4, 4.0), (5, 9.0), (6, 9.0))
    assert [store.save_best(*one) for one in scores] == [True, True, True, False, True, False]
    assert steps_in(store.best) == [2, 5]
    assert checkpoint_steps(best_checkpoint(store.best)) == 5
    (store.best / "checkpoint-000000000001.torchrl").write_text("damaged")
    assert checkpoint_steps(best_checkpoint(store.best)) == 1
    # it may be the best, so it is not removed in favour of others either
    assert store.save_best(7, 10.0)
    store.save(8)
    assert steps_in(store.best) == [1, 2, 7]
    assert best_checkpoint(tmp_path / "none") is None


def test_a_best_one_that_was_displaced_is_the_best_again_after_resuming_from_before(tmp_path):
    store = CheckpointStore(tmp_path, parts(1), keep_last=2)
    store.save(1)
    assert store.save_best(2, 5.0)
    store.save(2)
    for steps, score in ((3, 6.0), (4, 7.0)):
        assert store.save_best(steps, score)
    assert steps_in(store.best) == [2, 4]
    assert checkpoint_steps(best_checkpoint(store.best)) == 4
    again = CheckpointStore(tmp_path, parts(1), keep_last=1)
    assert again.resume()
    assert steps_in(store.best) == [2]
    assert again.save_best(4, 7.0)
    again.save(4)
    assert steps_in(store.best) == [4]
    # what a killed run has left behind is removed, too
    assert CheckpointStore(tmp_path, parts(1), keep_last=1, keep_best=2).save_best(5, 1.0)
    again.save(6)
    assert steps_in(store.best) == [4]


def test_what_was_best_before_the_first_checkpoint_is_removed_by_starting_over(tmp_path):
    store = CheckpointStore(tmp_path, parts(1), keep_last=1)
    assert store.resume() is None
    store.begin()
    store.save_best(1, 5.0)
    assert store.resume(epochs=1) is None
    assert steps_in(store.best) == []


def test_the_newest_one_says_what_is_wrong_and_whether_the_run_is_finished(tmp_path):
    store = CheckpointStore(tmp_path, parts(1), keep_last=2)
    store.save(10)
    store.save(20)
    assert [is_finished(checkpoints_in(store.last), frames) for frames in (20, 21)] == [True, False]
    for path in checkpoints_in(store.last):
        path.write_text("damaged")
    with pytest.raises(CheckpointError, match="000020"):
        store.resume()


def test_the_hash_is_that_of_the_weights_of_the_actor(tmp_path):
    def hash_of(actor, **others):
        return policy_hash(
            CheckpointStore(tmp_path, {"actor": actor, **others}, keep_last=1).save(1)
        )

    first = nn.Linear(3, 2)
    same = copy.deepcopy(first)
    assert hash_of(first) == hash_of(same, counter=Progress(2), critic=nn.Linear(1, 1))
    nn.init.ones_(first.weight)
    assert hash_of(first) != hash_of(same)
    # as many ones in another shape
    wide = nn.Linear(2, 3)
    hashes = set()
    for actor in (first, wide):
        nn.init.ones_(actor.weight)
        hashes.add(hash_of(nn.ParameterDict({"weight": actor.weight})))
    assert len(hashes) == 2


def test_what_is_held_is_read_after_its_file_is_gone(tmp_path):
    path = CheckpointStore(tmp_path, parts(3), keep_last=1).save(10)
    held = hold(path)
    path.unlink()
    assert read_states(held, ["counter"]) == {"counter": Progress(3).state_dict()}


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
    for read in (hold, lambda path: CheckpointStore.load(path, target)):
        with pytest.raises(CheckpointError, match=path.name):
            read(path)
    assert target["counter"].epoch == 7
    assert (target["network"].weight == 7).all()


def test_a_checkpoint_of_another_run_is_refused(tmp_path):
    path = CheckpointStore(tmp_path, parts(1), keep_last=1).save(10)
    with pytest.raises(CheckpointError, match="multiplier"):
        CheckpointStore.load(path, {**parts(7), "multiplier": Progress()})
    with pytest.raises(CheckpointError, match="size mismatch"):
        CheckpointStore.load(path, {"network": nn.Linear(4, 2)})


class Harmful:
    """Opens a file when it is unpickled."""

    def __init__(self, trace):
        self.trace = str(trace)

    def __reduce__(self):
        return open, (self.trace, "w")


def refuse(path, match):
    target = Progress(7)
    with pytest.raises(CheckpointError, match=match) as caught:
        CheckpointStore.load(path, {"counter": target})
    assert target.epoch == 7
    assert "\n" not in str(caught.value)
    assert "weights_only" not in str(caught.value)


def test_loading_runs_no_code_of_the_file(tmp_path):
    harmful = Harmful(tmp_path / "trace.txt")
    torch.save({"facts": {}, "parts": {"counter": {"value": harmful}}}, tmp_path / "a.torchrl")
    refuse(tmp_path / "a.torchrl", "holds more than tensors")
    assert not (tmp_path / "trace.txt").exists()
    torch.load(tmp_path / "a.torchrl", weights_only=False)
    assert (tmp_path / "trace.txt").exists()  # it is harmful indeed


def test_what_is_compressed_is_refused_before_it_fills_the_memory(tmp_path):
    path = CheckpointStore(tmp_path, {"counter": Progress(1)}, keep_last=1).save(10)
    with (
        zipfile.ZipFile(path) as old,
        zipfile.ZipFile(tmp_path / "a.torchrl", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    refuse(tmp_path / "a.torchrl", "compressed parts")


@pytest.mark.parametrize(
    "content",
    [
        *([], None, {}, {"facts": {}}, {"facts": 3, "parts": {}}, torch.ones(2)),
        *({"facts": [], "parts": {}}, {"facts": {}, "parts": []}),
        {"pi": {"weight": torch.ones(2)}},  # as OmniSafe stores the parts of its actor
    ],
)
def test_a_file_that_is_no_checkpoint_is_refused_and_stops_no_run(tmp_path, content):
    store = CheckpointStore(tmp_path, {"counter": Progress(1)}, keep_last=2)
    store.save_best(10, 1.0)
    store.save(10)
    for folder in (store.last, store.best):
        torch.save(content, folder / "checkpoint-000000000020.torchrl")
    refuse(store.last / "checkpoint-000000000020.torchrl", r"20\.torchrl: no run of .* wrote it\.$")
    with pytest.warns(UserWarning, match="Continuing from the older"):
        assert store.resume().name == "checkpoint-000000000010.torchrl"
    store.save(20)
    assert not store.save_best(20, 0.5)


def test_a_checkpoint_of_another_seed_is_not_resumed_from(tmp_path):
    counter = Progress(1)
    path = CheckpointStore(tmp_path, {"counter": counter}, keep_last=1, run={"seed": 3}).save(10)
    other = CheckpointStore(tmp_path, {"counter": counter}, keep_last=1, run={"seed": 0})
    with pytest.raises(CheckpointError, match=r"its seed is 3, this run's is 0\..*init_from="):
        other.resume()
    # its networks may be read all the same, and so may checkpoints that lack a fact, or have none
    CheckpointStore.load(path, {"counter": counter})
    facts = {"seed": 3, "new": 1}
    assert CheckpointStore(tmp_path, {"counter": counter}, keep_last=1, run=facts).resume() == path
    CheckpointStore(tmp_path, {"counter": counter}, keep_last=1).save(20)
    assert other.resume().name.endswith("20.torchrl")


@pytest.mark.parametrize(
    ("columns", "sensors", "words"),
    [
        (["b", "a"], {"bins": 16}, "their order is another one"),
        (["a", "b"], {"bins": 8}, "their bins is 16, and that of this environment 8"),
        (["a", "c"], {"bins": 16}, "they have b, where this environment has c"),
    ],
)
def test_other_observations_than_those_of_the_policy_are_refused(tmp_path, columns, sensors, words):
    known = {"columns": ["a", "b"], "sensors": {"bins": 16}}
    store = CheckpointStore(tmp_path, parts(1), keep_last=1, interface=lambda: known)
    path = store.save(10)
    check_interface(path, known)
    with pytest.raises(CheckpointError, match=words):
        check_interface(path, {"columns": columns, "sensors": sensors})
    # one that says nothing of them is not checked
    silent = CheckpointStore(tmp_path, parts(1), keep_last=1).save(10)
    check_interface(silent, {"columns": columns, "sensors": sensors})


def test_a_full_disk_leaves_the_checkpoints_that_were_there(tmp_path, monkeypatch):
    counter = Progress(1)
    store = CheckpointStore(tmp_path, {"counter": counter}, keep_last=1)
    path = store.save(10)

    def full(*args, **kwargs):  # as torch reports it
        raise RuntimeError("basic_ios::clear: iostream error\nand more")

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", full)
        counter.epoch = 2
        with pytest.raises(OSError, match="is the disk full") as caught:
            store.save(20)
    assert "\n" not in str(caught.value)
    assert list(store.last.iterdir()) == [path]
    store.resume()
    assert counter.epoch == 1


def test_the_best_can_be_one_of_before(tmp_path):
    components = parts(1)
    store = CheckpointStore(tmp_path, components, keep_last=1)
    states = {name: copy.deepcopy(part.state_dict()) for name, part in components.items()}
    components["counter"].epoch = 2
    assert store.save_best(10, 1.0, states=states)
    restored = parts(0)
    CheckpointStore.load(best_checkpoint(store.best), restored)
    assert restored["counter"].epoch == 1
