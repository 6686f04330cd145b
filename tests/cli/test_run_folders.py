"""Folders of new runs, as the command line makes them."""

import multiprocessing
import subprocess
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from safe_rl.cli.run_folders import new_folder

ROOT = Path(__file__).parents[2]


def hydra_config(directory, *overrides):
    return OmegaConf.create(
        {"run": {"dir": str(directory)}, "overrides": {"hydra": list(overrides)}}
    )


def claim(directory):
    return new_folder(hydra_config(directory))[0]


def test_runs_that_begin_in_the_same_second_get_folders_of_their_own(tmp_path):
    wanted = tmp_path / "PointGoal1" / "ppo" / "2026-01-31_12-00-00_seed0"
    with multiprocessing.get_context("fork").Pool(4) as pool:
        made = pool.map_async(claim, [wanted] * 12).get(timeout=300)
    assert sorted(made) == sorted(wanted.parent.iterdir())
    assert wanted in made
    assert len(set(made)) == 12


@pytest.mark.parametrize("override", ["hydra.run.dir", "+hydra.run.dir"])
def test_a_folder_that_was_named_stays(tmp_path, override):
    config = hydra_config(tmp_path, f"{override}={tmp_path}")
    assert new_folder(config) == (tmp_path, False)
    assert not list(tmp_path.iterdir())


TINY = [
    *("env.num_steps=40", "num_envs=2", "frames_per_batch=80", "logger=none", "num_threads=1"),
    *("model.hidden_sizes=[8]", "critic_update.num_passes=1", "policy_update.num_passes=1"),
]


def train(*arguments):
    return subprocess.run(
        [sys.executable, "train.py", *arguments],
        cwd=ROOT, capture_output=True, text=True, timeout=600,
    )  # fmt: skip


@pytest.mark.slow
def test_a_refused_run_changes_nothing_of_the_one_that_is_there(tmp_path):
    where = f"hydra.run.dir={tmp_path / 'run'}"
    assert train(*TINY, where, "frames=160").returncode == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert tmp_path / "run" / ".hydra" / "overrides.yaml" in before
    refused = train(*TINY, where, "frames=240", "seed=3")
    assert refused.returncode == 1
    assert "already holds a run. Continue it with: python train.py resume=" in refused.stderr
    broken = train(f"resume={tmp_path / 'run'}", "frames=240", "policy_update.max_kl=abc")
    assert broken.returncode == 1
    elsewhere = train(f"resume={tmp_path / 'run'}", f"hydra.run.dir={tmp_path / 'other'}")
    assert "cannot change" in elsewhere.stderr
    after = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert after == before
    # those that could not begin leave no folder
    crowded = train(*TINY, f"hydra.run.dir={tmp_path / 'new'}", "env.hazards_num=200")
    assert "attempts: most often 'hazard" in crowded.stderr
    assert "('hazards_num' is 200)" in crowded.stderr
    assert len(crowded.stderr.strip().splitlines()) == 1
    assert train(*TINY, f"hydra.run.dir={tmp_path / 'new'}", "frames=-1").returncode == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
