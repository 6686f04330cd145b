"""The files that a run writes while it trains, and its output on the terminal."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from time import monotonic
from typing import Any

from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from safe_rl.checks import SettingError
from safe_rl.files import read_json, replace_json, replacing
from safe_rl.runs.folder import lock_folder
from safe_rl.runs.identity import given_settings, measure_of
from safe_rl.runs.run import Run
from safe_rl.runs.table import TableWriter, measured, outcome_line, read_table
from safe_rl.trust import instantiate


class RunWriter:
    """Writes configuration, table, logger, learning curves and progress bar of one run.

    The folder holds ``config.yaml`` (resolved), ``code.json`` (the commits that the run used),
    ``progress.csv`` (a row per epoch), ``curves.png`` and the files of the configured logger.

    Args:
        run: The run; its folder is made if it does not exist.
        config: Configuration of the run.
        cost_limits: Cost key -> d, undiscounted cost per episode.
        episode_length: T_ep, steps of a full episode.

    Raises:
        ValueError: If ``MPLBACKEND`` names a backend that Matplotlib does not have.
    """

    def __init__(
        self,
        run: Run,
        config: DictConfig,
        cost_limits: Mapping[str, float],
        episode_length: int,
    ) -> None:
        # imported here, so that a wrong MPLBACKEND is an error before the run begins
        import matplotlib  # noqa: F401

        self.run, self.directory = run, run.directory
        self._config = config
        self._cost_limits = dict(cost_limits)
        self._episode_length, self._measure = episode_length, measure_of(config)

    @contextmanager
    def writing(self, epoch: int | None = None, steps: int = 0) -> Iterator[None]:
        """Keep the files open, and the folder locked.

        Args:
            epoch: Epochs that a continued run has made before; None for a new run.
            steps: Environment steps that it has made before.

        Raises:
            RunInUseError: If another process writes into the folder.
            SettingError: If the logger cannot be made of its settings.
            ValueError: If the table lacks epochs of the continued run.
        """
        self.directory.mkdir(parents=True, exist_ok=True)
        with lock_folder(self.run.lock_file), ExitStack() as opened:
            self._steps_before = steps
            # a continued run replaces it after its first epoch: wrong settings fail before
            self._is_config_saved = False
            # written before the table: a run without a configuration cannot be continued
            if epoch is None or not self.run.is_run:
                self._save_config()
            # before the table: a run that has none yet leaves no folder if its logger fails
            self._logger = self._make_logger()
            if self._logger is not None:
                opened.callback(self._logger.close)
            table = TableWriter(self.run.table_file, keep_rows=epoch or 0)
            self._table = opened.enter_context(table)
            if self._logger is not None and not epoch:
                given = given_settings(self.run.overrides or (), self._config)
                self._logger.log_hparams(given)
            # whole batches, so that the last one does not go beyond the bar
            batch = self._config.frames_per_batch
            total = math.ceil(self._config.frames / batch) * batch
            self._bar = ProgressBar(self.directory, total, steps, self._cost_limits, self._measure)
            opened.callback(self._bar.close)
            yield
            self._save_config()

    def _make_logger(self) -> Any:
        try:
            logger = instantiate(self._config.get("logger"), log_dir=str(self.directory))
        except (SettingError, OSError):
            raise
        except Exception as error:  # those of the services have types of their own
            raise SettingError(f"logger: {' '.join(str(error).split())}") from error
        for name in ("log_scalar", "log_hparams", "close"):
            if logger is not None and not callable(getattr(logger, name, None)):
                raise SettingError(
                    f"logger._target_={self._config.logger._target_}: it has no '{name}'. Derive a "
                    "logger of yours from torchrl.record.loggers.Logger."
                )
        return logger

    def _save_config(self) -> None:
        if not self._is_config_saved:
            # replaced atomically: a run killed here can still be continued
            with replacing(self.run.config_file) as unfinished:
                OmegaConf.save(self._config, unfinished, resolve=True)
            note_code(self.run.code_file, self._steps_before)
            self._is_config_saved = True

    def add(self, row: Mapping[str, float]) -> None:
        """Write an epoch to the table and the logger, and show it."""
        self._save_config()
        self._table.write(row)
        if self._logger is not None:
            for name, value in row.items():
                if not math.isnan(value):
                    self._logger.log_scalar(name, value, step=int(row["steps"]))
        self._bar.add(row)

    def rows(self) -> list[dict[str, float]]:
        """The rows of the table, each by column."""
        table = read_table(self.run.table_file) if self.run.num_rows else {}
        return [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]

    def draw_curves(self) -> None:
        """Write ``curves.png`` from the table; if that fails, say so: training goes on."""
        # imported here: matplotlib takes half a second
        from safe_rl.runs.curves import learning_curves, save_figure

        table, config = read_table(self.run.table_file), self._config
        title = f"{config.env.name} {config.algo.name} seed {config.seed}"
        try:
            figure = learning_curves(
                table, self._cost_limits, self._episode_length, title, self._measure
            )
            save_figure(figure, self.run.curves_file)
        except (OSError, RuntimeError, ValueError) as error:  # such as text.usetex without LaTeX
            reason = " ".join(str(error).split())
            print(f"{self.run.curves_file} was not drawn: {reason}", file=sys.stderr)

    def summary(self) -> str:
        """One line about the end of the run."""
        table = read_table(self.run.table_file)
        line = outcome_line(table, self._cost_limits, self._episode_length, self._measure)
        return f"{line}; {self.directory}"


LINE_SECONDS = "SAFE_RL_LINE_SECONDS"
"""Environment variable of runs that share a terminal: they print lines, this many seconds apart."""


class ProgressBar:
    """A bar with steps, steps per second, return, and costs with their present limits.

    Args:
        directory: Folder of the run; if lines replace the bar, they begin with its name.
        total: Environment steps of the whole run.
        begun: Steps that a continued run has made before.
    """

    def __init__(
        self,
        directory: Path,
        total: int,
        begun: int,
        limits: Mapping[str, float],
        measure: str = "mean",
    ) -> None:
        self._name = os.path.relpath(directory)
        self._seconds = float(os.environ.get(LINE_SECONDS, "inf"))
        self._printed = monotonic()
        options = {"disable": True} if math.isfinite(self._seconds) else {}
        self._bar = tqdm(
            total=total, initial=begun, unit=" steps", unit_scale=True, dynamic_ncols=True,
            smoothing=0.1, **options,
        )  # fmt: skip
        self._limits, self._measure = limits, measure

    def add(self, row: Mapping[str, float]) -> None:
        """Show an epoch, given as its row of the table."""
        figures = shown(row, self._limits, self._measure)
        self._bar.set_postfix(figures, refresh=False)
        self._bar.update(int(row["steps"]) - self._bar.n)
        if monotonic() - self._printed >= self._seconds:
            self._printed = monotonic()
            words = [f"{row['steps'] / self._bar.total:.0%} of {self._bar.total:,} steps"]
            words += [f"{row['steps_per_second']:,.0f} steps/s"]
            words += [f"{name}={value}" for name, value in figures.items()]
            print(f"{self._name}: {', '.join(words)}", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Close the bar; its last state stays on the terminal."""
        self._bar.close()


def shown(
    row: Mapping[str, float], limits: Mapping[str, float], measure: str = "mean"
) -> dict[str, str]:
    """Figures of an epoch for the bar: return, costs with their present limits, multipliers.

    Return and costs are means over the episodes that ended in the epoch. While an algorithm lowers
    its limit, the word "target" precedes the present one.

    Examples:
        >>> row = {"episode_return": 1.25, "episode_cost": 30.0, "multiplier_cost": 0.5}
        >>> shown(row, {"cost": 25.0})
        {'return': '1.25', 'cost': '30.0/25', 'λ': '0.5'}
        >>> shown(row | {"estimate_cost": 31.0, "target_cost": 29.0}, {"cost": 25.0})["cost"]
        '30.0/target 29'
    """
    if math.isnan(row["episode_return"]):
        return {"episodes": "none has ended"}
    figures = {"return": f"{row['episode_return']:.2f}"}
    for key in list(limits) or ["cost"]:
        value = measured(row, key, limits.get(key), measure)
        figures[key] = f"{value:.1f}{_present_limit(row, key, limits)}"
    multipliers = [value for name, value in row.items() if name.startswith("multiplier_")]
    if multipliers:
        figures["λ"] = " ".join(f"{value:.3g}" for value in multipliers)
    return figures


def _present_limit(row: Mapping[str, float], key: str, limits: Mapping[str, float]) -> str:
    """The present limit of a cost, to follow its figure."""
    if key not in limits:
        return ""
    target, limit = row.get(f"target_{key}", -math.inf), limits[key]
    if target <= limit:
        return f"/{limit:g}"
    if target > row.get(f"estimate_{key}", math.inf):
        return " (no limit yet)"
    return f"/target {target:.3g}"


def note_code(path: Path, steps: int) -> None:
    """Add the present version of the code to the file that lists the versions of a run.

    Args:
        path: The file, a list of JSON objects with ``steps``, ``version``, ``commit`` and
            ``changed``; see `code_of`.
        steps: Environment steps that the run has made.
    """
    try:
        entries = [entry for entry in read_json(path) if entry["steps"] < steps]
    except (OSError, ValueError, TypeError, KeyError):
        entries = []  # there is no file yet, or it is damaged
    code = code_of()
    if not entries or any(entries[-1].get(name) != value for name, value in code.items()):
        entries.append({"steps": steps, **code})
    replace_json(path, entries)


@cache
def code_of() -> Mapping[str, Any]:
    """The code of this process: ``version``, ``commit`` and ``changed``.

    The last two are None if the package is not in a checkout, or Git is missing.

    Examples:
        >>> sorted(code_of())
        ['changed', 'commit', 'version']
    """
    module = import_module("safe_rl")
    commit, changed = commit_of(Path(str(module.__file__)))
    return {"version": module.__version__, "commit": commit, "changed": changed}


def commit_of(file: Path) -> tuple[str | None, bool | None]:
    """The commit of the checkout that a file belongs to, and whether it has been changed since.

    Both are None if Git does not track the file: an installed package may be inside the checkout of
    another project.

    Examples:
        >>> commit_of(Path("/nowhere/module.py"))
        (None, None)
    """
    known = _git(file.parent, "ls-files", "--error-unmatch", file.name)
    description = known and _git(
        file.parent, "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"
    )
    if not description:
        return None, None
    return description.removesuffix("-dirty"), description.endswith("-dirty")


def _git(directory: Path, *arguments: str) -> str:
    """The output of Git without its newline; empty if the command fails."""
    # without locks, which could make the user's own Git commands fail
    command = ["git", "--no-optional-locks", *arguments]
    try:
        result = subprocess.run(
            command, cwd=directory, timeout=5.0, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return result.stdout.strip()
