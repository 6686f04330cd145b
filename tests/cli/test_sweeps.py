"""Sweeps: how many jobs and threads, failing jobs, and a whole sweep started again."""

import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from commands import ROOT, SMALL, composed, in_a_process
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import JobReturn
from hydra.types import RunMode
from omegaconf import OmegaConf

from safe_rl.cli.sweeps import Summary, run_in_sweep, run_job
from safe_rl.runs.folder import checkpoint_steps
from safe_rl.runs.progress_bar import LINE_SECONDS, ProgressBar
from safe_rl.runs.run import find_runs
from safe_rl.runs.table import final_figures, read_table


@pytest.mark.parametrize(("workers", "threads"), [(1, 8), (2, 4), (3, 2), (16, 1)])
def test_jobs_at_a_time_share_the_cores(tmp_path, monkeypatch, workers, threads):
    joblib = pytest.importorskip("joblib")
    monkeypatch.setattr(joblib, "cpu_count", lambda: 8)
    monkeypatch.setenv("SAFE_RL_NUM_THREADS", "1")
    monkeypatch.setenv(LINE_SECONDS, "1")
    node = {"launcher": {"n_jobs": workers}, "sweep": {"dir": str(tmp_path)}}
    config = OmegaConf.create({"hydra": node})
    Summary(f"{tmp_path}/sweeps/first.jsonl").on_multirun_start(config)
    assert os.environ["SAFE_RL_NUM_THREADS"] == str(threads)


def test_a_failing_job_is_named_and_stops_nobody(tmp_path, monkeypatch, capsys):
    summary = Summary(f"{tmp_path}/jobs.jsonl")
    outcomes = [3.5, ValueError("no such cost\nmore"), SystemExit(130), *[0.0] * 4]

    def carry_out(number, folder=None):
        directory = tmp_path / f"seed{number if folder is None else folder}"
        runtime = {"choices": {}, "config_sources": [], "output_dir": str(directory)}
        node = {"job": {"num": number}, "runtime": runtime, "overrides": {"task": []}}
        config = OmegaConf.create({"hydra": node | {"mode": RunMode.MULTIRUN}})
        summary.on_job_start(config)
        made = OmegaConf.create({"env": {"name": "mine"}, "algo": {}})
        run_in_sweep(made, config.hydra, directory)
        summary.on_job_end(config, JobReturn())

    monkeypatch.setattr("safe_rl.cli.sweeps.run_job", Mock(side_effect=outcomes))
    monkeypatch.setattr("safe_rl.cli.sweeps.check_settings", lambda config: None)
    (tmp_path / "seed0").mkdir()
    (tmp_path / "seed0" / "failure.txt").write_text("of last time")
    carry_out(0)
    assert not (tmp_path / "seed0" / "failure.txt").exists()
    carry_out(1)
    with pytest.raises(SystemExit):
        carry_out(2)
    with pytest.raises(SystemExit):
        summary.on_multirun_end(None)
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        "Sweep: 1 of 3 runs are finished.",
        f"  failed: {tmp_path}/seed1",
        f"  interrupted: {tmp_path}/seed2",
        "Start it again as it was: finished runs are skipped, the others continue.",
    ]
    assert err == f"{tmp_path}/seed1: ValueError: no such cost more\n"
    assert "ValueError: no such cost\nmore" in (tmp_path / "seed1" / "failure.txt").read_text()
    for number in range(3):
        carry_out(number)
    summary.on_multirun_end(None)
    assert capsys.readouterr().out == "Sweep: 3 of 3 runs are finished.\n"
    carry_out(3, folder=0)  # a key that is not in a folder's name, such as num_threads
    summary.on_multirun_end(None)
    assert f"Several jobs have the folder {tmp_path}/seed0, in" in capsys.readouterr().out


def test_sweeps_and_runs_that_begin_in_the_same_second_have_files_of_their_own():
    """The jobs of a cluster's array do; the first sweep called the others' runs interrupted."""
    nodes = [composed()[0].hydra for _ in range(3)]
    assert len({node.callbacks.summary.log for node in nodes}) == 3
    assert len({node.run.dir for node in nodes}) == 3


def test_a_sweep_without_a_run_fails(tmp_path):
    with pytest.raises(SystemExit, match=r"no runs: a glob"):
        Summary(f"{tmp_path}/jobs.jsonl").on_multirun_end(None)


def test_runs_that_share_a_terminal_print_lines(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(LINE_SECONDS, "0")
    row = {"steps": 250, "steps_per_second": 5000.0, "episode_return": 1.5, "episode_cost": 30.0}
    bar = ProgressBar(tmp_path / "seed0", 1000, 0, {"cost": 25.0}, "mean")
    bar.add({**row, "multiplier_cost": 0.5})
    bar.close()
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("seed0:  25%")
    assert line.endswith("steps/s, return=1.50, cost=30.0/25, λ=0.5]")


@pytest.mark.parametrize(
    ("words", "between"),
    [
        ([], "."),
        (["num_threads=2", "logger=none", "record=true", "certificate.episodes=0"], "."),
        (["env.hazards_num=1", "import=json"], "env.hazards_num=1"),
        ([f"+note={'a' * 300}"], f"+note={'a' * 194}-2c268a09"),
    ],
)
def test_folders_of_a_sweep_name_what_a_person_overrode(words, between):
    config = composed("env=PointGoal1", "algo=cpo", "seed=0", *words)[0]
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)
    try:
        folder = Path(config.hydra.sweep.subdir)
    finally:
        HydraConfig.instance().cfg = before
    assert folder == Path("PointGoal1") / "cpo" / between / "seed0"


@pytest.mark.parametrize(("algo", "value"), [("ppo", 1.0), ("cpo", -math.inf)])
def test_only_an_algorithm_that_keeps_limits_is_judged_by_them(monkeypatch, algo, value):
    monkeypatch.setattr("safe_rl.training.train.train", lambda *_, **__: None)
    final = {"episode_return": 1.0, "episode_cost": 60.0}
    run = SimpleNamespace(is_run=False, directory=None, final=final, cost_limits={"cost": 25.0})
    assert run_job(composed(f"algo={algo}")[0], None, run) == value


def sweep(directory, *overrides, status=0):
    words = (*SMALL, "frames=120", f"hydra.sweep.dir={directory}", *overrides)
    return in_a_process("train.py", "-m", *words, status=status)


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "basic"])
def test_a_sweep_end_to_end(tmp_path, launcher):
    if launcher == "joblib":
        pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    # the constrained algorithm cannot work without a limit, the other one does not need any
    jobs = ["env=PointGoal1", "algo=trpo,cpo", "seed=0,10", f"hydra/launcher={launcher}"]
    jobs += ["default_cost_limits=null", "cost_limits={}", "++policy_update.target_kl=0.01"]
    first = sweep(tmp_path, *jobs, status=1)
    assert "Sweep: 2 of 4 runs are finished." in first
    assert first.count("needs at least one entry in cost_limits") == 2
    tables = sorted(tmp_path.glob("PointGoal1/trpo/*/seed*/progress.csv"))
    assert [table.parent.name for table in tables] == ["seed0", "seed10"]
    assert not list(tmp_path.glob("PointGoal1/cpo/*/*/progress.csv"))
    before = [table.stat().st_mtime_ns for table in tables]
    assert sweep(tmp_path, *jobs, status=1).count("has 120 frames already") == 2
    assert [table.stat().st_mtime_ns for table in tables] == before
    journals = sorted((tmp_path / "sweeps").iterdir())
    notes = [json.loads(line) for line in journals[0].read_text().splitlines()]
    states = [state for _, state, _ in notes]
    assert sorted(states) == ["done"] * 2 + ["failed"] * 2 + ["interrupted"] * 4


@pytest.mark.long
def test_jobs_in_other_processes_know_the_keys_of_a_users_module(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    keys = ["env=PointGoal1", "env.constrain_mines=true", "env.mines_num=1", "algo=ppo"]
    keys += ["hydra/launcher=joblib", "import=examples/custom_environment.py"]
    assert "Sweep: 2 of 2 runs are finished." in sweep(tmp_path, *keys, "seed=0,1")


def writers(directory):
    """Folder -> process that writes it, of the runs below a folder."""
    return {r.directory: int(r.lock_file.read_text().split()[1]) for r in find_runs(directory)}


def wait_until(condition, seconds):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.2)


def is_running(pid):
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


@pytest.mark.slow
def test_jobs_have_their_folders_for_themselves_and_end_with_the_sweep(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    command = [
        *(sys.executable, "train.py", "-m", *SMALL, f"hydra.sweep.dir={tmp_path}", "seed=0,1"),
        *("hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "frames=100_000_000"),
    ]
    first = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    try:
        wait_until(lambda: [r.num_rows > 1 for r in find_runs(tmp_path)] == [True, True], 900)
        processes = writers(tmp_path)
        again = in_a_process(*command[1:], status=1)
        for directory, pid in processes.items():
            said = f"{directory}: RunInUseError: {directory} is being written by process {pid}"
            assert said in again
        assert writers(tmp_path) == processes
        assert not list(tmp_path.rglob("failure.txt"))
    finally:
        first.kill()
        first.wait()
    wait_until(lambda: not any(map(is_running, processes.values())), 120)
    # they had the time to write what they had come to
    for run in find_runs(tmp_path):
        assert checkpoint_steps(run.newest_checkpoint()) == run.steps


@pytest.mark.long
def test_optuna_takes_the_return_within_the_limits(tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs 'sweep-optuna'")
    search = ["hydra/sweeper=optuna", "hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=1"]
    search += ["hydra.sweeper.direction=maximize", "hydra/launcher=basic", "env=PointGoal1"]
    said = sweep(tmp_path, *search, "lagrangian.kp=interval(0.1,1)")
    assert "Sweep: 2 of 2 runs are finished." in said
    best = OmegaConf.load(tmp_path / "optimization_results.yaml")
    tables = [read_table(path) for path in tmp_path.rglob("progress.csv")]
    returns = [max(final_figures(table, ["cost"])["episode_return"] for table in tables)]
    assert best.best_value in (pytest.approx(returns[0]), -math.inf)
