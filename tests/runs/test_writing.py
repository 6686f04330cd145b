"""What a run writes: final figures by hand, and what loggers hold, also of a continued run."""

import math
import sys

import pytest
from omegaconf import OmegaConf
from point_mass_runs import point_mass_trainer
from run_configs import compose_config
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from safe_rl.checks import SettingError
from safe_rl.runs.loggers import WandbLogger
from safe_rl.runs.run import Run
from safe_rl.runs.table import final_figures, read_table
from safe_rl.runs.writing import RunWriter
from safe_rl.trust import allow

NAN = math.nan


def row(epoch, episode_return, cost, north_cost=0.0):
    episodes = {"return": episode_return, "cost": cost, "cost_north": north_cost}
    progress = {"epoch": epoch, "steps": 1000 * epoch, "time_total": 2.0 * epoch}
    rates = {"cost_rate": 0.001 * epoch, "cost_north_rate": 0.002, "multiplier_cost": 0.5}
    return progress | {f"episode_{name}": value for name, value in episodes.items()} | rates


@pytest.mark.parametrize(
    ("epoch", "epochs", "width"),
    [(20_000, 50, 5), (30_000, 30, 5), (5_000, 200, 20), (5_000, 40, 8), (1_000, 7, 5), (10, 3, 3)],
)
def test_algorithms_with_short_epochs_are_judged_by_as_many_steps(epoch, epochs, width):
    numbers = [float(number) for number in range(epochs)]
    table = {
        "episode_return": numbers,
        "cost_rate": numbers,
        "episode_cost": [2 * number for number in numbers],
        "steps": [epoch * (number + 1) for number in numbers],
        "time_total": [1.0] * epochs,
    }
    final = final_figures(table, ["cost"])
    assert final["episode_return"] == pytest.approx(sum(numbers[-width:]) / width)
    assert final["episode_cost"] == pytest.approx(2 * final["episode_return"])


def test_the_folder_has_configuration_table_and_tensorboard(tmp_path, capsys, curves):
    config = compose_config("env=PointMass", "cost_limits={cost: 25, cost_north: 5}", "frames=1500",
                            "frames_per_batch=1000")  # fmt: skip
    writer = RunWriter(Run(tmp_path / "run"), config, {"cost": 25.0, "cost_north": 5.0}, 1000)
    with writer.writing():
        writer.add(row(1, NAN, NAN, NAN))
        writer.add(row(2, 1.5, 30.0, 4.0))
    writer.draw_curves()
    saved = OmegaConf.load(tmp_path / "run" / "config.yaml")
    assert saved == OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    events = EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()
    costs = [(event.step, event.value) for event in events.Scalars("episode_cost")]
    assert costs == [(2000, 30.0)]
    assert {event.step for event in events.Scalars("multiplier_cost")} == {1000, 2000}
    assert writer.summary() == (
        "Return 1.50, cost 30.0 (limit 25), cost_north 4.0 (limit 5) per episode, mean of steps "
        f"1,001 to 2,000; 500 steps/s; {tmp_path / 'run'}"
    )
    bar = capsys.readouterr().err
    assert "return=1.50, cost=30.0/25, cost_north=4.0/5" in bar
    assert "λ=0.5" in bar
    assert "2.00k/2.00k" in bar
    assert "nan" not in bar


def test_a_picture_that_cannot_be_drawn_ends_no_run(tmp_path, capsys, curves, monkeypatch):
    import matplotlib

    monkeypatch.setitem(matplotlib.rcParams, "text.usetex", True)
    monkeypatch.setenv("PATH", str(tmp_path))  # without LaTeX
    writer = RunWriter(Run(tmp_path), compose_config("env=PointMass", "logger=none"), {}, 1000)
    with writer.writing():
        writer.add(row(1, 1.0, 20.0))
    writer.draw_curves()
    assert "curves.png was not drawn: " in capsys.readouterr().err


def test_a_risk_measure_is_what_is_held_against_the_limit(tmp_path, capsys):
    config = compose_config("env=PointMass", "logger=none", "risk=cvar")
    writer = RunWriter(Run(tmp_path), config, {"cost": 25.0}, 1000)
    with writer.writing():
        writer.add(row(1, 1.0, 20.0) | {"violation_cost": 62.0})
        writer.add(row(2, 1.0, 30.0) | {"violation_cost": 64.0})
    assert "cost 25.0, limited measure 88.0 (limit 25)" in writer.summary()
    with writer.writing(0):
        writer.add(row(1, NAN, NAN) | {"violation_cost": NAN})
    assert "No episode of 1,000 steps has ended" in writer.summary()
    assert "cost=89.0/25" in capsys.readouterr().err


def test_what_is_killed_while_it_begins_leaves_no_table_without_a_configuration(
    tmp_path, monkeypatch
):
    """Which could neither be begun anew nor continued."""

    def kill(*arguments):
        raise KeyboardInterrupt

    config = compose_config("env=PointMass", "logger=none")
    monkeypatch.setattr(RunWriter, "_save_config", kill)
    with pytest.raises(KeyboardInterrupt):
        RunWriter(Run(tmp_path), config, {}, 1000).writing().__enter__()
    assert not Run(tmp_path).has_begun


def test_an_estimate_of_the_mean_is_no_other_measure(tmp_path, capsys):
    """limits=paper estimates the mean from batches shorter than episodes."""
    config = compose_config("env=PointMass", "logger=none", "limits=paper")
    writer = RunWriter(Run(tmp_path), config, {"cost": 25.0}, 1000)
    with writer.writing():
        writer.add(row(1, 1.0, 20.0) | {"violation_cost": 62.0})
    assert "cost 20.0 (limit 25)" in writer.summary()
    assert "cost=20.0/25" in capsys.readouterr().err
    run = Run(tmp_path)
    assert (run.measure, run.excess("cost")) == ("mean", -5.0)
    assert not run.limits_another_measure("cost")


def train(directory, *overrides):
    trainer = point_mass_trainer(directory, *overrides)
    if trainer.writer.run.has_begun:
        trainer.resume()
    trainer.run()


def test_mlflow_holds_the_table_and_continues_the_same_run(tmp_path):
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy", reason="only the whole of MLflow has its own database")
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    overrides = ["logger=mlflow", f"logger.tracking_uri={uri}"]
    train(tmp_path / "run", *overrides, "frames=640")
    train(tmp_path / "run", *overrides, "frames=960")
    train(tmp_path / "other", *overrides, "frames=160", "seed=1")
    client = mlflow.MlflowClient(uri)
    experiment = client.get_experiment_by_name("PointMass")
    runs = {run.info.run_name: run for run in client.search_runs([experiment.experiment_id])}
    assert set(runs) == {str(tmp_path / "run"), str(tmp_path / "other")}
    run = runs[str(tmp_path / "run")]
    table = read_table(tmp_path / "run" / "progress.csv")
    history = client.get_metric_history(run.info.run_id, "policy_kl")
    assert {metric.step: metric.value for metric in history} == dict(
        zip(table["steps"], table["policy_kl"], strict=True)
    )
    assert run.info.status == "FINISHED"
    assert {"env.name": "PointMass", "frames": "640"}.items() <= run.data.params.items()
    # the address of a server may have a password
    assert not any(uri in value for value in run.data.params.values())


def test_what_is_not_installed_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install -e '\.\[wandb\]'"):
        WandbLogger(exp_name="mine", project="p", offline=True, log_dir=str(tmp_path))


class Scalars:
    steps = []  # noqa: RUF012

    def __init__(self, log_dir):
        self.log_dir = log_dir

    def log_scalar(self, name, value, step):
        self.steps.append(step)

    def log_hparams(self, cfg):
        assert cfg["env"]["name"] == "PointMass"

    def close(self):
        pass


def test_a_logger_of_ones_own_needs_only_to_log(tmp_path):
    allow(__name__)
    own = f"logger._target_={__name__}.Scalars"
    train(tmp_path, own, "frames=160")
    train(tmp_path, own, "frames=320")
    assert sorted(set(Scalars.steps)) == [160, 320]


class Mute:
    def __init__(self, log_dir):
        pass


class Refused(Mute):
    def __init__(self, log_dir):
        raise Exception("unknown\nuri")


@pytest.mark.parametrize(
    ("name", "words"), [("Mute", "it has no 'log_scalar'"), ("Refused", "^logger: unknown uri$")]
)
def test_a_logger_that_cannot_log_is_refused_before_the_run_begins(name, words, tmp_path):
    allow(__name__)
    with pytest.raises(SettingError, match=words):
        train(tmp_path / "run", f"logger._target_={__name__}.{name}", "frames=160")
    assert not (tmp_path / "run" / "progress.csv").exists()
