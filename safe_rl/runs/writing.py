"""The files that a run writes while it trains, also which version of the code it uses."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from safe_rl.checks import SettingError
from safe_rl.files import is_plain, read_json, replace_json, replacing
from safe_rl.runs.folder import lock_folder
from safe_rl.runs.identity import measure_of, whole_frames
from safe_rl.runs.progress_bar import ProgressBar
from safe_rl.runs.run import Run
from safe_rl.runs.table import TableWriter, outcome_line, read_table
from safe_rl.trust import allowed, instantiate


@dataclass
class RunWriter:
    """Writes configuration, versions of the code, table, logger, curves and bar of one run."""

    run: Run
    config: DictConfig
    cost_limits: Mapping[str, float]  # cost key -> d, undiscounted cost per episode
    episode_length: int  # T_ep, steps of a full episode

    @contextmanager
    def writing(self, epoch: int | None = None, steps: int = 0) -> Iterator[None]:
        """Keep logger and bar open, and the folder, which is made if it is missing, locked.

        A continued run has made `epoch` epochs and `steps` environment steps before; `epoch` is
        None for a new run.

        Raises:
            RunInUseError, SettingError, TableError: If another process writes into the folder, the
                logger cannot be made, or the table lacks epochs of the continued run.
        """
        self.run.directory.mkdir(parents=True, exist_ok=True)
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
            self._table = TableWriter(self.run.table_file, keep_rows=epoch or 0)
            if self._logger is not None and not epoch:
                settings: Any = OmegaConf.to_container(self.config, resolve=True)
                settings.pop("logger", None)  # an address may have a password
                self._logger.log_hparams(settings)
            # whole batches, so that the last one does not go beyond the bar
            total, measure = whole_frames(self.config), measure_of(self.config)
            self._bar = opened.enter_context(
                ProgressBar(self.run.directory, total, steps, self.cost_limits, measure)
            )
            yield

    def _make_logger(self) -> Any:
        try:
            logger = instantiate(self.config.get("logger"), log_dir=str(self.run.directory))
        except (SettingError, OSError):
            raise
        except Exception as error:  # those of the services have types of their own
            raise SettingError(f"logger: {' '.join(str(error).split())}") from error
        for name in ("log_scalar", "log_hparams", "close"):
            if logger is not None and not callable(getattr(logger, name, None)):
                raise SettingError(
                    f"logger._target_={self.config.logger._target_}: it has no '{name}'. Derive a "
                    "logger of yours from torchrl.record.loggers.Logger."
                )
        return logger

    def _save_config(self) -> None:
        if not self._is_config_saved:
            if not is_plain(OmegaConf.to_container(self.config, resolve=True)):
                raise SettingError("A text has '${' or control characters: no run could be opened.")
            # replaced atomically: a run killed here can still be continued
            with replacing(self.run.config_file) as unfinished:
                OmegaConf.save(self.config, unfinished, resolve=True)
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

    def draw_curves(self) -> None:
        """Write ``curves.png`` from the table; if that fails, say so: training goes on."""
        table, config = read_table(self.run.table_file), self.config
        title = f"{config.env.name} {config.algo.name} seed {config.seed}"
        limits, length, measure = self.cost_limits, self.episode_length, measure_of(config)
        try:
            # imported here: matplotlib takes half a second, and refuses an unknown MPLBACKEND
            from safe_rl.runs.curves import learning_curves, save_figure

            figure = learning_curves(table, limits, length, title, measure)
            save_figure(figure, self.run.curves_file)
        except (OSError, RuntimeError, ValueError) as error:  # such as text.usetex without LaTeX
            reason = " ".join(str(error).split())
            print(f"{self.run.curves_file} was not drawn: {reason}", file=sys.stderr)

    def summary(self) -> str:
        """One line about the end of the run."""
        table, measure = read_table(self.run.table_file), measure_of(self.config)
        line = outcome_line(table, self.cost_limits, self.episode_length, measure)
        return f"{line}; {self.run.directory}"


def note_code(path: Path, steps: int) -> None:
    """Add the present version of the code to the file that lists the versions of a run.

    The file is a list of JSON objects: the entries of `code_of`, the ``steps`` that the run had
    made, and in ``imports`` the same entries of each of the user's modules.
    """
    try:
        entries = [entry for entry in (read_json(path) if steps else ()) if entry["steps"] < steps]
    except (OSError, ValueError, TypeError, KeyError):
        entries = []  # there is no file yet, or it is damaged
    code = {**code_of(Path(__file__)), "version": import_module("safe_rl").__version__}
    files = {name: getattr(sys.modules.get(name), "__file__", None) for name in allowed()}
    if imports := {name: code_of(Path(file)) for name, file in files.items() if file}:
        code["imports"] = imports
    if not entries or any(entries[-1].get(name) != value for name, value in code.items()):
        entries.append({"steps": steps, **code})
    replace_json(path, entries)


@cache
def code_of(file: Path) -> Mapping[str, Any]:
    """``commit`` of a file's checkout, and whether that is ``changed``.

    Both are None if Git does not track the file: an installed package may be inside the checkout of
    another project.

    Examples:
        >>> code_of(Path("/nowhere/module.py"))["commit"] is None
        True
    """
    commit = _git(file.parent, "ls-files", "--error-unmatch", file.name) and _git(
        file.parent, "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"
    )
    return {
        "commit": commit.removesuffix("-dirty") or None,
        "changed": commit.endswith("-dirty") if commit else None,
    }


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
