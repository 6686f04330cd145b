"""Folders of runs that somebody else has made: links must not lead what is written out of them."""

import pytest

from safe_rl.cli.report import ReportOptions, report
from safe_rl.collectors import Recording
from safe_rl.files import replace_text
from safe_rl.runs.folder import lock_folder
from safe_rl.runs.loggers import TensorboardLogger
from safe_rl.runs.run import Run

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
    "place", ["transitions", "checkpoints", "checkpoints/last", "checkpoints/best", "code.json"]
)
def test_a_folder_with_links_is_not_written_to(place, tmp_path):
    mine, run = tmp_path / "mine", tmp_path / "run"
    mine.mkdir()
    (mine / "00000000.pt").touch()
    (run / place).parent.mkdir(parents=True)
    (run / place).symlink_to(mine)
    with pytest.raises(ValueError, match=rf"{place} is a link"), lock_folder(Run(run).lock_file):
        pass
    assert listing(mine) == ["00000000.pt"]


def test_a_linked_recording_is_not_begun_anew(tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "00000003.pt").touch()
    (tmp_path / "run").symlink_to(mine)
    with pytest.raises(ValueError, match="is a link"):
        Recording(tmp_path / "run", ["cost"]).begin()
    assert listing(mine) == ["00000003.pt"]


def test_events_stay_in_the_folder_of_the_run(tmp_path):
    with pytest.raises(ValueError, match="it names a folder in that of the run"):
        TensorboardLogger(exp_name="../elsewhere", log_dir=str(tmp_path / "run"))
    assert not (tmp_path / "elsewhere").exists()


def test_a_linked_report_is_not_written(tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "report").symlink_to(mine)
    with pytest.raises(ValueError, match="report is a link"):
        report(tmp_path / "runs", ReportOptions())
    assert not listing(mine)
