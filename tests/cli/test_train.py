"""The command train.py as a whole: what Hydra is asked passes, what is wrong leaves nothing."""

from pathlib import Path
from unittest.mock import Mock

import pytest
from commands import SMALL, in_a_process, status_of

from safe_rl.envs import ConfigError
from safe_rl.runs.table import read_table
from safe_rl.training.trainer import Trainer


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Runs train.py in an empty folder; returns its status and what it printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    return lambda *arguments: (status_of(*arguments), *capsys.readouterr())


def test_configurations_are_shown(command):
    status, out, _ = command("--cfg", "job", "frames=7")
    assert not status
    assert "frames: 7\n" in out
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["hydra.run.dir=/proc/runs"], "/proc/runs"),
        (["init_from=nowhere"], "init_from=nowhere: there is no such folder or file."),
        (["hydra.run.dir="], "hydra.run.dir= is empty"),
        (["-m", "hydra.sweep.dir="], "hydra.sweep.dir= is empty"),
        (["transforms=[saute,saute]"], "a transform is there twice"),
        (["logger.exp_name=3"], "logger.exp_name=3: it must be a valid string"),
        (["logger._target_=torch.optim.Adam"], "logger.exp_name: Adam has no such argument. Leave"),
        (
            ["policy_update.optimizer._target_=torch.optim.RMSprop"],
            "policy_update: RMSprop.__init__() got an unexpected keyword argument 'fused'",
        ),
        (
            ["loss._target_=safe_rl.objectives.PPOLoss", "~loss.cost_clipping"],
            "lagrangian: safe_rl.objectives.PPOLoss has no argument 'multiplier'",
        ),
        (["algo=cpo", "cost_limits={}", "hydra.run.dir=a/b"], "algo=cpo needs at least one entry"),
    ],
)
def test_what_is_wrong_is_said_in_a_line_and_leaves_nothing(command, overrides, words):
    status, _, err = command(*overrides)
    said = err or status
    assert status
    assert words in said
    assert len(said.strip().splitlines()) == 1
    assert [path for path in Path.cwd().rglob("*") if path.is_file()] == []


def test_the_whole_error_is_there_for_those_who_ask(command, monkeypatch):
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(Exception, match="Could not override 'lr'"):
        command("lr=1e-4")
    with pytest.raises(ValueError, match="at least one entry"):
        command("env=PointGoal1", "algo=cpo", "cost_limits={}", "num_envs=1")


@pytest.mark.parametrize(("overrides", "lines"), [([], 1), (["certificate.episodes=0"], 0)])
def test_a_run_too_short_for_its_certificate_says_so(command, overrides, lines):
    status, out, _ = command(*SMALL, "frames=40", *overrides, "hydra.run.dir=runs/short")
    assert not status
    said = [line for line in out.splitlines() if line.startswith("Not certified: ")]
    assert len(said) == lines
    for line in said:
        assert "frames=40 are fewer than 12,000, a fifth of the steps of certificate.ep" in line
        assert line.endswith(f"safe-rl certify {Path('runs/short').resolve()}")
    assert not Path("runs/short/certificate.json").exists()


def test_what_is_said_at_the_start_is_about_the_batches_and_the_schedule_of_the_run(command):
    status, out, _ = command(*SMALL, "frames=30", "hydra.run.dir=runs/mine")
    assert not status
    assert "Training for 40 frames: whole batches of 40." in out
    # two environments end their first episodes of 20 steps
    assert "No episode will" not in out
    assert "This schedule" not in out
    # resume=RUN frames=… leaves the schedule, which may then end after the run
    status, out, _ = command("resume=runs/mine", "frames=70", "limits.frames=81")
    assert not status
    assert "This schedule was made for 81 frames. If the limits are to fall sooner: " in out
    assert "Resuming after 40 of 80 frames." in out
    assert "limits.frames=70" in out


def test_a_run_without_a_certified_policy_says_how_to_train_on(command):
    status, out, _ = command(
        *(*SMALL, "frames=400", "certificate.episodes=100", "certificate.ranking=2"),
        *("cost_limits={cost: 1.1}", "env.hazards_size=5", "import=json"),
        "hydra.run.dir=runs/unsafe",
    )
    assert not status
    line = out.splitlines()[-1]
    before, _, overrides = line.partition("python train.py ")
    assert before == "To train on: "
    assert command(*overrides.split())[0] == 0
    assert int(read_table(Path("runs/unsafe/progress.csv"))["steps"][-1]) == 800


def test_a_run_interrupted_while_it_is_certified_is_certified_when_it_is_resumed(
    command, monkeypatch
):
    interrupt = Mock(side_effect=KeyboardInterrupt)
    with monkeypatch.context() as patch:
        patch.setattr("safe_rl.evaluation.certifying.certify", interrupt)
        status, out, _ = command(
            *(*SMALL, "frames=40", "certificate.episodes=2", "certificate.ranking=2"),
            "hydra.run.dir=runs/mine",
        )
    assert status == 130
    before, _, resume = out.splitlines()[-1].partition("python train.py ")
    assert before == "Interrupted before it was certified. To do so: "
    assert not Path("runs/mine/certificate.json").exists()
    status, out, _ = command(resume)
    assert status == 0
    assert "40 frames already. To train on: " in out
    assert Path("runs/mine/certificate.json").exists()


@pytest.mark.long
def test_a_backend_that_matplotlib_does_not_know_leaves_a_run_without_a_picture(tmp_path):
    words = ("train.py", *SMALL, "frames=40", f"hydra.run.dir={tmp_path / 'run'}")
    said = in_a_process(*words, MPLBACKEND="nonsense")
    assert "curves.png was not drawn: " in said
    assert "'nonsense' is not a valid value for backend" in said
    assert "Traceback" not in said


SAC = ("algo=sac", *SMALL[:-1], "memory.capacity=20_000")
OUT_OF_MEMORY = RuntimeError("alloc_cpu.cpp:127] can't allocate memory:\nyou")


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        (SMALL, ConfigError("the cost is not finite"), "the cost is not finite"),
        (SMALL, FloatingPointError("the cost is not finite"), "the cost is not finite"),
        (SMALL, MemoryError(), "not enough memory with frames_per_batch=40, num_envs=2"),
        (SMALL, OUT_OF_MEMORY, "not enough memory with"),
        (SAC, MemoryError(), "with memory.capacity=20000, frames_per_batch=40, num_envs=2 and"),
    ],
)
def test_what_is_wrong_while_it_trains_ends_the_run_in_a_line(
    command, monkeypatch, settings, error, words
):
    monkeypatch.setattr(Trainer, "epoch", Mock(side_effect=error))
    (line,) = command(*settings, "frames=40")[0].splitlines()
    assert words in line


def test_an_error_that_no_setting_explains_keeps_its_traceback(command, monkeypatch):
    monkeypatch.setattr(Trainer, "epoch", Mock(side_effect=ValueError("shapes differ")))
    with pytest.raises(ValueError, match="shapes differ"):
        command(*SMALL, "frames=40")
