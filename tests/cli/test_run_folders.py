"""Folders of new runs, as the command line makes them."""

import multiprocessing
from functools import partial

import pytest
from commands import SMALL, in_a_process, status_of

from safe_rl.runs.folder import RunInUseError, new_folder


def test_runs_that_begin_in_the_same_second_get_folders_of_their_own(tmp_path):
    wanted = tmp_path / "PointGoal1" / "ppo" / "2026-01-31_12-00-00_seed0"
    with multiprocessing.get_context("fork").Pool(4) as pool:
        made = pool.map_async(new_folder, [wanted] * 12).get(timeout=300)
    assert sorted(made) == sorted(wanted.parent.iterdir())
    assert wanted in made
    assert len(set(made)) == 12


def test_a_folder_that_another_process_makes_first_stays(tmp_path, monkeypatch):
    def refuse(file):
        (file.parent / "robot").mkdir(parents=True)
        raise RunInUseError("in use")

    monkeypatch.setattr("safe_rl.training.train.lock_folder", refuse)
    assert status_of(*SMALL, f"hydra.run.dir={tmp_path / 'run'}") == "in use"
    assert (tmp_path / "run" / "robot").is_dir()


@pytest.mark.slow
def test_a_refused_run_changes_nothing_of_the_one_that_is_there(tmp_path):
    train = partial(in_a_process, "train.py", status=1)
    run, new = tmp_path / "run", (*SMALL, f"hydra.run.dir={tmp_path / 'new'}")
    train(*SMALL, f"hydra.run.dir={run}", "frames=80", status=0)

    def contents():
        files = (path for path in tmp_path.rglob("*") if path.is_file())
        # the lock names the process that came last
        return {path: path.read_bytes() for path in files if path.name != ".lock"}

    before = contents()
    refused = train(*SMALL, f"hydra.run.dir={run}", "frames=120", "seed=3")
    assert "already holds a run. Continue it with: python train.py resume=" in refused
    train(f"resume={run}", "frames=120", "policy_update.max_kl=abc")
    assert "in its folder" in train(f"resume={run}", f"hydra.run.dir={tmp_path / 'other'}")
    assert contents() == before
    # those that could not begin leave no folder
    crowded = train(*new, "env.hazards_num=200")
    assert "attempts: most often 'hazard" in crowded
    assert "('hazards_num' is 200)" in crowded
    assert len(crowded.strip().splitlines()) == 1
    train(*new, "frames=-1")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
