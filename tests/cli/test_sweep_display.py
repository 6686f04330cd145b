"""What a sweep shows of runs in other processes: their own figures, and no more than there are."""

import json
import pickle
import sys

import pytest
from omegaconf import OmegaConf

from safe_rl.cli.sweeps import SweepReport, _Display, progress_of
from safe_rl.runs.table import TableWriter

ROW = {"steps": 250, "episode_return": 1.5, "episode_cost": 30.0, "multiplier_cost": 0.5}


@pytest.fixture
def sweep(tmp_path):
    """A sweep's journal, and what begins and ends jobs in it."""
    journal = tmp_path / "sweeps" / "now.jsonl"
    journal.parent.mkdir()
    journal.touch()

    def note(job, event):
        directory = str(tmp_path / f"seed{job}")
        with journal.open("a") as file:
            file.write(json.dumps({"job": job, "event": event, "directory": directory}) + "\n")

    return journal, note


def write_run(directory, *rows, limits="{cost: 25}"):
    directory.mkdir(exist_ok=True)
    (directory / "config.yaml").write_text(f"frames: 1000\ncost_limits: {limits}\n")
    with TableWriter(directory / "progress.csv") as table:
        for row in rows:
            table.write(row | {"steps_per_second": 5000.0})


def test_progress_is_the_last_row_that_is_complete(tmp_path):
    assert progress_of(tmp_path / "seed0") == "its first epoch"
    write_run(tmp_path / "seed0")
    assert progress_of(tmp_path / "seed0") == "its first epoch"
    write_run(tmp_path / "seed0", ROW, {**ROW, "steps": 500, "episode_return": 2.0})
    with (tmp_path / "seed0" / "progress.csv").open("a") as file:
        file.write("750,9.")
    expected = "50% of 1,000 steps, 5,000 steps/s, return=2.00, cost=30.0/25, λ=0.5"
    assert progress_of(tmp_path / "seed0") == expected


def test_each_run_at_hand_gets_a_line(sweep, tmp_path, capsys):
    journal, note = sweep
    for job in range(3):
        note(job, "begun")
    write_run(tmp_path / "seed0", ROW)
    write_run(tmp_path / "seed1", ROW, limits="{}")
    note(0, "done")
    with journal.open("a") as file:
        file.write('{"job": 2, "ev')
    display, said = _Display(journal, seconds=0.01), ""
    while "seed2" not in said:
        said += capsys.readouterr().err
    display.stop()
    assert said.splitlines()[:2] == [
        "seed1: 25% of 1,000 steps, 5,000 steps/s, return=1.50, cost=30.0, λ=0.5",
        "seed2: its first epoch",
    ]


def test_a_process_imports_the_users_modules_before_it_composes(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "module_of_a_sweep.py").write_text("")
    report = SweepReport()
    report._modules = [str(tmp_path / "module_of_a_sweep.py")]
    sent = pickle.dumps(report)
    assert "module_of_a_sweep" not in sys.modules
    pickle.loads(sent)
    assert "module_of_a_sweep" in sys.modules


def test_jobs_get_the_report_without_what_shows_them(sweep, tmp_path):
    launcher = {"_target_": "hydra_plugins.somewhere.OtherLauncher"}
    hydra = {"sweeper": {}, "overrides": {"task": ["seed=0,1"]}, "sweep": {"dir": str(tmp_path)}}
    report = SweepReport()
    report.on_multirun_start(OmegaConf.create({"hydra": {**hydra, "launcher": launcher}}))
    sent = pickle.loads(pickle.dumps(report))
    assert vars(sent)["_display"] is None
    assert vars(sent)["_journal"] == vars(report)["_journal"]
    with pytest.raises(SystemExit):
        report.on_multirun_end(OmegaConf.create({}))
