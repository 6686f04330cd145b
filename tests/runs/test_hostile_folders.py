"""Folders of runs that somebody else has made: links must not lead what is written out of them."""

import pytest
import yaml

from safe_rl.cli.report import ReportOptions, report
from safe_rl.evaluation.loading import robot_of
from safe_rl.evaluation.policies import pack_policy
from safe_rl.files import replace_text
from safe_rl.runs.folder import lock_folder
from safe_rl.runs.loggers import TensorboardLogger
from safe_rl.runs.run import Run

MINE = "export SECRET=1"


def listing(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_link_in_the_place_of_an_unfinished_file_is_not_followed(tmp_path, monkeypatch):
    """Not even if its name could be foreseen."""
    mine, run = tmp_path / "bashrc", tmp_path / "run"
    run.mkdir()
    mine.write_text(MINE)
    with monkeypatch.context() as patch:
        patch.setattr("secrets.token_hex", lambda size: "0a")
        (run / ".progress.0a.csv").symlink_to(mine)
        with pytest.raises(FileExistsError):
            replace_text(run / "progress.csv", "steps\n")
    (run / "code.json").symlink_to(mine)
    replace_text(run / "code.json", "[]")  # takes the link's place
    assert mine.read_text() == MINE
    assert (run / "code.json").read_text() == "[]"
    assert listing(run) == [".progress.0a.csv", "code.json"]


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
    with pytest.raises(ValueError, match=rf"{place} is a link"):  # nor given away
        pack_policy(run, tmp_path / "exported")
    assert listing(mine) == ["00000000.pt"]


@pytest.mark.parametrize("name", ["../elsewhere", "..", "../", "a/b"])
def test_events_stay_in_the_folder_of_the_run(name, tmp_path):
    with pytest.raises(ValueError, match="it names a folder in that of the run"):
        TensorboardLogger(exp_name=name, log_dir=str(tmp_path / "run"))
    assert listing(tmp_path) == []


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"env": {"name": ".."}}, "env"),
        ({"algo": {"name": "../mine"}}, "algo"),
        ({"algo": 3}, "algo"),
        ({"import": 5}, "import"),
        ({"seed": "x"}, "seed"),
        ({"cost_limits": [25]}, "cost_limits"),
        ({"transforms": "saute"}, "transforms"),
    ],
)
def test_a_configuration_that_no_run_writes_is_refused_in_one_line(changes, key, tmp_path):
    settings = {"env": {"name": "a"}, "algo": {"name": "b"}, "seed": 0, "cost_limits": {}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    assert Run(tmp_path).seed == 0
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings | changes))
    with pytest.raises(ValueError, match=f"it lacks a usable {key}\\.$"):
        Run(tmp_path).config  # noqa: B018


@pytest.mark.parametrize("content", ["[1]", "{}", '"x"'])
def test_a_note_about_a_robot_that_no_run_writes_is_refused(content, tmp_path):
    (tmp_path / "robot.json").write_text(content)
    with pytest.raises(ValueError, match="is not as a run writes it"):
        robot_of(Run(tmp_path), {"robot_base": "mine.xml"})


def test_a_linked_report_is_not_written(tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "report").symlink_to(mine)
    with pytest.raises(ValueError, match="report is a link"):
        report(tmp_path / "runs", ReportOptions())
    assert not listing(mine)
