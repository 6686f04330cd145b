"""Loggers of others: what they hold of a run, and of one that was continued."""

import sys

import pytest
from point_mass_runs import point_mass_trainer

from safe_rl.checks import SettingError
from safe_rl.runs.loggers import WandbLogger
from safe_rl.runs.table import read_table
from safe_rl.trust import allow


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
    """A logger of one's own, with what it must have and nothing else."""

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
    """What logs nothing."""

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
