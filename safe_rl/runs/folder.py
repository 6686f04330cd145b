"""What a run leaves in its folder and shows on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from safe_rl.runs.curves import SMOOTHING_EPOCHS, draw_learning_curves
from safe_rl.runs.table import TableWriter, read_table
from safe_rl.targets import build

__all__ = ["FINAL_EPOCHS", "RunFolder", "final_figures"]

FINAL_EPOCHS = SMOOTHING_EPOCHS  # so that curves end at the final figures
"""Epochs over which the final J_r and J_c are averaged (Ray et al. 2019, section 5.1)."""


class RunFolder:
    """Configuration, table, logger, learning curves and progress bar of one run.

    The folder holds ``config.yaml`` (resolved), ``progress.csv`` (a row per epoch), ``curves.png``
    and what the configured logger writes.

    Args:
        directory: The folder; made if it does not exist.
        config: Configuration of the run.
        cost_limits: Cost key -> d, undiscounted cost per episode.
        episode_length: T_ep, steps of a full episode.

    Examples:
        >>> import tempfile
        >>> config = OmegaConf.create({"frames": 200, "logger": {}, "algo": {"name": "ppo"}})
        >>> folder = RunFolder(Path(tempfile.mkdtemp()), config, {"cost": 25.0}, 1000)
        >>> row = {"steps": 200, "episode_return": 1.0, "episode_cost": 30.0, "cost_rate": 0.03}
        >>> with folder.writing():
        ...     folder.record(row | {"time_total": 2.0})
        ...     folder.draw_curves()
        >>> folder.summary().split(" in ")[0]
        'J_r 1.00, J_c 30.0 (limit 25), ρ_c 0.0300, 100 steps/s'
    """

    def __init__(
        self,
        directory: Path,
        config: DictConfig,
        cost_limits: Mapping[str, float],
        episode_length: int,
    ) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.directory = directory
        self._config = config
        self._cost_limits = dict(cost_limits)
        self._episode_length = episode_length

    @property
    def table_path(self) -> Path:
        """The CSV file."""
        return self.directory / "progress.csv"

    @property
    def holds_run(self) -> bool:
        """Whether a run has been begun here."""
        return self.table_path.exists()

    @property
    def checkpoint_directory(self) -> Path:
        """Folder of the checkpoints."""
        return self.directory / "checkpoints"

    @contextmanager
    def writing(self, epoch: int | None = None, steps: int = 0) -> Iterator[None]:
        """Keep the files open.

        Args:
            epoch: Epochs that a continued run has behind it; None for a new run.
            steps: Environment steps that it has behind it.

        Raises:
            FileExistsError: If a new run would overwrite one that is there.
            ValueError: If the table lacks epochs of the run that is to be continued.
        """
        if epoch is None and self.holds_run:
            raise FileExistsError(
                f"{self.directory} already holds a run. Continue it with 'python train.py "
                f"resume={self.directory}', or give this one another folder with hydra.run.dir=..."
            )
        self._table = TableWriter(self.table_path, keep_rows=epoch or 0)
        self._save_config()
        logger = self._config.logger
        self._logger = build(logger, log_dir=str(self.directory)) if logger else None
        continue_from = getattr(self._logger, "continue_from", None)
        if epoch is not None and continue_from is not None:
            continue_from(steps)
        self._bar = tqdm(
            total=self._config.frames, initial=steps, unit=" steps", unit_scale=True,
            dynamic_ncols=True, smoothing=0.1,
        )  # fmt: skip
        self._shown: dict[str, str] = {}
        try:
            yield
        finally:
            self._bar.close()
            self._table.close()
            close = getattr(self._logger, "close", None)
            if close is not None:
                close()

    def _save_config(self) -> None:
        # replaced in one go: a run killed here can still be continued
        path = self.directory / "config.tmp"
        OmegaConf.save(self._config, path, resolve=True)
        path.replace(self.directory / "config.yaml")

    def record(self, row: Mapping[str, float]) -> None:
        """Write one epoch to table and logger and show it."""
        self._table.write(row)
        if self._logger is not None:
            for name, value in row.items():
                if not math.isnan(value):
                    self._logger.log_scalar(name, value, step=int(row["steps"]))
        self._shown |= self._postfix(row)
        self._bar.set_postfix(self._shown, refresh=False)
        self._bar.update(int(row["steps"]) - self._bar.n)

    def _postfix(self, row: Mapping[str, float]) -> dict[str, str]:
        """What the bar shows of an epoch: only what is known in it."""
        shown = {"return": f"{row['episode_return']:.2f}"}
        for key in self._cost_limits or ["cost"]:
            limit = f"/{self._cost_limits[key]:g}" if key in self._cost_limits else ""
            shown[key] = f"{self._measured(row, key):.1f}{limit}"
        if math.isnan(row["episode_return"]):
            shown = {}
        multipliers = [value for name, value in row.items() if name.startswith("multiplier_")]
        if multipliers:
            shown["λ"] = " ".join(f"{value:.3g}" for value in multipliers)
        return shown

    def _measured(self, row: Mapping[str, float], key: str) -> float:
        """What is held against a limit: the mean episode cost, or the algorithm's own measure."""
        violation = row.get(f"violation_{key}")
        return row[f"episode_{key}"] if violation is None else self._cost_limits[key] + violation

    def draw_curves(self) -> None:
        """Write ``curves.png`` from the table."""
        table = read_table(self.table_path)
        config = self._config
        seed = f"seed {config.seed}" if "seed" in config else ""
        title = f"{config.get('env', {}).get('name', '')} {config.algo.name} {seed}".strip()
        path = self.directory / "curves.png"
        draw_learning_curves(table, self._cost_limits, self._episode_length, path, title)

    def summary(self) -> str:
        """One line on how the run ended."""
        keys = list(self._cost_limits) or ["cost"]
        final = final_figures(read_table(self.table_path), keys)
        parts = [f"J_r {final['episode_return']:.2f}"]
        several = len(self._cost_limits) > 1
        for key in self._cost_limits or ["cost"]:
            name = f"[{key}]" if several else ""
            limit = f" (limit {self._cost_limits[key]:g})" if key in self._cost_limits else ""
            mean, measured = final[f"episode_{key}"], self._measured(final, key)
            differs = abs(measured - mean) > 0.05  # false without any episode
            own = f", measured {measured:.1f}" if differs else ""
            parts.append(f"J_c{name} {mean:.1f}{own}{limit}")
            parts.append(f"ρ_c{name} {final[f'{key}_rate']:.4f}")  # noqa: RUF001
        parts.append(f"{final['steps_per_second']:,.0f} steps/s")
        return f"{', '.join(parts)} in {self.directory}"


def final_figures(table: Mapping[str, list[float]], cost_keys: list[str]) -> dict[str, float]:
    """Final J_r, J_c and ρ_c (Ray et al. 2019, section 5.1), and steps per second of the run.

    J_r, J_c and violations of limits are means over the last ``FINAL_EPOCHS`` epochs in which an
    episode finished, ρ_c is that of the last epoch.

    Args:
        table: Columns of the run's table.
        cost_keys: Keys of the costs to report.
    """
    known = [row for row, value in enumerate(table["episode_return"]) if not math.isnan(value)]
    final: dict[str, Any] = {}
    names = [f"{kind}_{key}" for key in cost_keys for kind in ("episode", "violation")]
    for name in ("episode_return", *(name for name in names if name in table)):
        values = [table[name][row] for row in known[-FINAL_EPOCHS:]]
        final[name] = sum(values) / len(values) if values else math.nan
    final |= {f"{key}_rate": table[f"{key}_rate"][-1] for key in cost_keys}
    final["steps_per_second"] = table["steps"][-1] / table["time_total"][-1]
    return final
