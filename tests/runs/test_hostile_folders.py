"""Folders of runs that somebody else has made: links must not lead what is written out of them."""

import json
import os
import shutil

import pytest
import torch
from point_mass_runs import point_mass_trainer
from tensordict import TensorDict

from safe_rl.cli.report import ReportOptions, report
from safe_rl.collectors import Recording, read_recording
from safe_rl.files import replace_text
from safe_rl.runs.folder import RunFolder, lock_folder
from safe_rl.runs.loggers import TensorboardLogger

MINE = "export SECRET=1"


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_link_in_the_place_of_an_unfinished_file_is_not_followed(tmp_path):
    """Where the name could be foreseen, a link of this name was written through."""
    mine, run = tmp_path / "bashrc", tmp_path / "run"
    run.mkdir()
    mine.write_text(MINE)
    (run / ".progress.unfinished.csv").symlink_to(mine)
    replace_text(run / "progress.csv", "steps\n")
    (run / "code.json").symlink_to(mine)
    replace_text(run / "code.json", "[]")  # takes the link's place
    assert mine.read_text() == MINE
    assert (run / "code.json").read_text() == "[]"
    assert listing(run) == [".progress.unfinished.csv", "code.json", "progress.csv"]


@pytest.mark.parametrize(
    "place",
    ["transitions", "checkpoints", "checkpoints/last", "checkpoints/best", "code.json"],
)
def test_a_folder_with_links_is_not_written_to(place, tmp_path):
    mine, run = tmp_path / "mine", tmp_path / "run"
    (mine / "00000000").mkdir(parents=True)
    (run / place).parent.mkdir(parents=True)
    (run / place).symlink_to(mine)
    with pytest.raises(ValueError, match=rf"{place} is a link"), lock_folder(RunFolder(run)):
        pass
    assert listing(mine) == ["00000000"]


def test_a_resumed_run_removes_nothing_behind_a_link(tmp_path):
    run, mine = tmp_path / "run", tmp_path / "mine"
    point_mass_trainer(run, "record=true", "frames=160").run()
    shutil.move(run / "transitions", mine)
    (run / "transitions").symlink_to(mine)
    before = listing(mine)
    with pytest.raises(ValueError, match="is a link"):
        point_mass_trainer(run, "record=true", "frames=320").resume()
    assert listing(mine) == before


def test_a_linked_recording_is_not_begun_anew(tmp_path):
    mine = tmp_path / "mine"
    (mine / "00000003").mkdir(parents=True)
    (tmp_path / "run").symlink_to(mine)
    with pytest.raises(ValueError, match="is a link"):
        Recording(tmp_path / "run", ["cost"]).begin()
    assert listing(mine) == ["00000003"]


def test_events_stay_in_the_folder_of_the_run(tmp_path):
    with pytest.raises(ValueError, match="it names a folder in that of the run"):
        TensorboardLogger(exp_name="../elsewhere", log_dir=str(tmp_path / "run"))
    assert not (tmp_path / "elsewhere").exists()


@pytest.fixture
def recording(tmp_path):
    """One batch [4, 20], as a run has recorded it."""
    flags = dict.fromkeys(("done", "terminated", "truncated"), torch.zeros(4, 20, 1).bool())
    following = {"observation": torch.rand(4, 20, 3), "reward": torch.rand(4, 20, 1), **flags}
    batch = TensorDict(
        {"observation": torch.rand(4, 20, 3), "action": torch.rand(4, 20, 2), "next": following},
        batch_size=[4, 20],
    )
    Recording(tmp_path / "transitions", []).write(0, batch)
    return tmp_path / "transitions"


def test_a_file_that_was_cut_is_refused_and_not_filled_with_zeros(recording):
    path = recording / "00000000" / "action.memmap"
    os.truncate(path, 80)
    with pytest.raises(ValueError, match=r"action\.memmap has 80 bytes of 640"):
        read_recording(recording)
    assert path.stat().st_size == 80


def test_reading_follows_no_link_and_writes_to_none(recording, tmp_path):
    mine = tmp_path / "mine"
    mine.write_bytes(b"short")
    path = recording / "00000000" / "next" / "reward.memmap"
    path.unlink()
    path.symlink_to(mine)
    with pytest.raises(ValueError, match=r"reward\.memmap is a link"):
        read_recording(recording)
    assert mine.read_bytes() == b"short"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": [10**9, 10**9]}, "action.memmap has 640 bytes"),
        ({"shape": [-1, 20, 2]}, "would have the shape"),
        ({"dtype": "torch.load"}, "cannot be read as steps"),
        ({"shape": "many"}, "cannot be read as steps"),
    ],
)
def test_notes_of_a_recording_are_not_trusted(changes, message, recording):
    path = recording / "00000000" / "meta.json"
    notes = json.loads(path.read_text())
    notes["action"] |= changes
    path.write_text(json.dumps(notes))
    with pytest.raises(ValueError, match=message):
        read_recording(recording)


def test_an_entry_does_not_lead_out_of_the_recording(recording):
    path = recording / "00000000" / "meta.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"../x": {"type": "TensorDict"}}))
    with pytest.raises(ValueError, match="names an entry"):
        read_recording(recording)


def test_a_linked_report_is_not_written(tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "report").symlink_to(mine)
    with pytest.raises(ValueError, match="report is a link"):
        report(tmp_path / "runs", ReportOptions())
    assert not listing(mine)
