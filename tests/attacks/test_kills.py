"""Kills at random moments: of training, sweeps, evaluations, certificates and exports."""

import os
import signal
import time
from contextlib import suppress
from threading import Thread

import pytest
from attacking import RUN, begin_or_continue, cases, exit_code_of, kill_all, said_by, start
from run_configs import compose_config, without_times

import safe_rl
from safe_rl.evaluation.policies import pack_policy
from safe_rl.files import read_json
from safe_rl.runs.folder import is_unfinished
from safe_rl.runs.run import Run
from safe_rl.training.train import train


def to_be_killed(work, after, *arguments):
    """Do something in this process, which is killed after some seconds."""
    Thread(target=lambda: (time.sleep(after), os.kill(os.getpid(), signal.SIGKILL))).start()
    with suppress(FileNotFoundError):  # a run without a checkpoint
        work(*arguments)
    os._exit(0)


def killed(after, work, *arguments):
    """Whether a process was killed before it had done its work."""
    code = exit_code_of(to_be_killed, work, after, *arguments)
    assert code in (0, -signal.SIGKILL)
    return code != 0


PROBLEMS = (
    ("env=PointGoal1", "algo=ppo_lagrangian", "policy_update.minibatch_size=20"),
    ("env=CarPush2", "algo=cpo"),
    ("env=PointButton1", "algo=cup", "policy_update.minibatch_size=20"),
    ("env=PointGoal1", "algo=sac_lagrangian", "exploration.random_steps=80", "memory.keep=true"),
)


def test_training_leaves_the_table_of_a_run_that_was_not_killed(tmp_path):
    times = []
    for number, random in enumerate(cases("kills of training", 90, least=len(PROBLEMS))):
        problem = PROBLEMS[number % len(PROBLEMS)]
        short = tuple(word for word in RUN if not word.startswith("critic_update"))
        words = [*(short if "algo=sac" in problem[1] else RUN), *problem, "frames=600"]
        words += ["certificate.episodes=0"]
        whole, folder = tmp_path / f"whole{number}", tmp_path / f"killed{number}"
        begun = time.monotonic()
        begin_or_continue(whole, words)
        times.append(time.monotonic() - begun)
        count = sum(
            killed(random.uniform(0, 2 * times[-1]), begin_or_continue, folder, words)
            for _ in range(4)
        )
        begin_or_continue(folder, words)
        tables = [without_times(Run(place).table_file) for place in (whole, folder)]
        assert tables[0] == tables[1], f"after {count} kills"
        assert not [path for path in folder.rglob(".*") if is_unfinished(path)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained") / "run"
    test = ["certificate.ranking=2", "certificate.episodes=20", "cost_limits={cost: 1000}"]
    train(compose_config(*RUN, "frames=160", *test), folder)
    assert Run(folder).certificate["certified"]
    return folder


def evaluate(folder):
    safe_rl.evaluate(folder, episodes=20, num_envs=4, num_threads=1, record=True)


def certify(folder):
    safe_rl.load(folder).certify(episodes=30)


def export(folder):
    pack_policy(folder, folder / "packed", "last")


@pytest.mark.parametrize("work", [evaluate, certify, export])
def test_what_is_killed_can_be_done_again_and_says_nothing_false(work, trained, tmp_path):
    folder = trained.rename(tmp_path / "run")
    try:
        for random in cases(f"kills of {work.__name__}", 20):
            killed(random.uniform(0, 3), work, folder)
            run = safe_rl.load(folder, checkpoint="certified")
            assert run.certificate_of(run.find_checkpoint("certified")) is not None
            assert all(map(read_json, run.evaluation_files))
        work(folder)
        assert not list((folder / "packed").glob(".*")) or work is not export
    finally:
        folder.rename(trained)


def test_a_sweep_that_is_killed_is_finished_by_the_same_command(tmp_path):
    words = ("train.py", "-m", *RUN[:-1], "frames=200", "seed=0,1", "certificate.episodes=0")
    said_by(start(*words, f"hydra.sweep.dir={tmp_path / 'whole'}"))
    for random in cases("kills of sweeps", 40, least=2):
        process = start(*words, f"hydra.sweep.dir={tmp_path / 'killed'}")
        time.sleep(random.uniform(4, 25))
        kill_all(process)
    assert "2 of 2 runs are finished" in said_by(
        start(*words, f"hydra.sweep.dir={tmp_path / 'killed'}")
    )
    whole, again = (sorted((tmp_path / n).rglob("progress.csv")) for n in ("whole", "killed"))
    assert [without_times(path) for path in whole] == [without_times(path) for path in again]
    assert len(whole) == 2


def test_a_clock_that_jumps_back_changes_no_number(tmp_path, monkeypatch):
    words = [*RUN, *PROBLEMS[0], "frames=400", "certificate.episodes=0", "logger=tensorboard"]
    begin_or_continue(tmp_path / "usual", words)
    now = time.time

    def jump(row):
        if row["epoch"] == 4:
            monkeypatch.setattr(time, "time", lambda: now() - 1e8)
        return row["epoch"] != 6

    folder = tmp_path / "jumped"
    train(compose_config(*words), folder, callbacks=[jump])
    monkeypatch.setattr(time, "time", lambda: now() - 2e8)
    begin_or_continue(folder, words)
    tables = [without_times(tmp_path / name / "progress.csv") for name in ("usual", "jumped")]
    assert tables[0] == tables[1]
