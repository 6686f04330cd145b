"""TorchRL's loggers, which here continue an interrupted run.

Each keeps its files or the id of its run in the folder ``log_dir``. Values that are logged again
after an interruption are the same as before.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from secrets import token_hex
from typing import Any

from torchrl.record.loggers.mlflow import MLFlowLogger
from torchrl.record.loggers.tensorboard import TensorboardLogger as TorchRLTensorboardLogger
from torchrl.record.loggers.wandb import WandbLogger as TorchRLWandbLogger

from safe_rl.checks import Text, checked
from safe_rl.extras import import_extra
from safe_rl.files import read_text, replace_text
from safe_rl.runs.identity import flatten
from safe_rl.runs.run import Run


@checked
class TensorboardLogger(TorchRLTensorboardLogger):
    """Event files for TensorBoard.

    Args:
        exp_name: Folder of the event files, below ``log_dir``.
        log_dir: Folder of the run.

    Raises:
        ValueError: If ``exp_name`` is no name of a folder.
    """

    def __init__(self, exp_name: Text, log_dir: str) -> None:
        if Path(exp_name).name != exp_name or exp_name == "..":
            raise ValueError(f"logger.exp_name={exp_name}: it names a folder in that of the run.")
        super().__init__(exp_name, log_dir)

    def log_hparams(self, cfg: Mapping[str, Any]) -> None:
        """Log no settings: TorchRL's method would make another run of TensorBoard for them."""


@checked
class MLflowLogger(MLFlowLogger):
    """A run of an MLflow experiment; a continued run uses the same MLflow run.

    Args:
        exp_name: Name of the experiment.
        tracking_uri: Database or server, such as ``sqlite:///runs/mlflow.db``.
        log_dir: Folder of the run, where the id of the MLflow run is kept.

    Raises:
        ModuleNotFoundError: If MLflow is not installed.
    """

    def __init__(self, exp_name: Text, tracking_uri: Text, log_dir: str) -> None:
        self._mlflow = import_extra("mlflow", extra="mlflow")
        self._directory = Path(log_dir)
        super().__init__(exp_name=exp_name, tracking_uri=tracking_uri)

    def _create_experiment(self) -> Any:
        path = Run(self._directory).logger_id_file("mlflow")
        self.id = self._mlflow.set_experiment(self.exp_name).experiment_id
        run = self._mlflow.start_run(
            run_id=read_text(path) if path.exists() else None,
            experiment_id=self.id,
            run_name=str(self._directory),
        )
        replace_text(path, run.info.run_id)
        return run

    def log_hparams(self, cfg: Mapping[str, Any]) -> None:
        """Log settings by their dotted keys: MLflow has no nested ones."""
        super().log_hparams(flatten(cfg))

    def close(self, timeout: float | None = None) -> None:
        """End the MLflow run, so that this process can begin another one."""
        self._mlflow.end_run()


@checked
class WandbLogger(TorchRLWandbLogger):
    """A run of Weights & Biases; a continued run uses the same W&B run.

    Args:
        exp_name: Name of the run.
        project: Name of the project.
        offline: Whether to keep everything in the folder of the run.
        log_dir: Folder of the run, where the id of the run is kept.
        kwargs: Other arguments of TorchRL's logger and of ``wandb.init``.

    Raises:
        ModuleNotFoundError: If wandb is not installed.
    """

    def __init__(
        self, exp_name: Text, project: Text, offline: bool, log_dir: str, **kwargs: Any
    ) -> None:
        import_extra("wandb", extra="wandb")
        path = Run(log_dir).logger_id_file("wandb")
        run_id = read_text(path) if path.exists() else token_hex(4)
        replace_text(path, run_id)
        super().__init__(
            exp_name, offline=offline, project=project, log_dir=log_dir, id=run_id, **kwargs
        )
