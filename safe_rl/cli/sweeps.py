"""Sweeps of many runs: threads per job, what the jobs are doing, and what became of every one."""

from __future__ import annotations

import atexit
import json
import math
import os
import sys
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from itertools import count
from pathlib import Path
from threading import Event, Thread
from typing import Any, NamedTuple, TextIO

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from tqdm import tqdm

from safe_rl.cli.user_code import import_modules, imported
from safe_rl.files import read_config, replace_text
from safe_rl.processes import end_with_parent
from safe_rl.runs.display import shown
from safe_rl.runs.folder import RunFolder, RunInUseError
from safe_rl.runs.table import last_row

__all__ = ["SweepReport", "count_jobs", "progress_of", "threads_per_job"]

_IN_TURN = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
"""The launcher whose jobs run in this process, with a bar of their own."""
_GRACE = 30.0
"""Seconds in which a job whose sweep was killed may end its epoch and write a checkpoint."""
_SECONDS = 1.0
_SECONDS_OF_A_LOG = 60.0
"""Between two looks at the runs: where lines can be drawn anew, and where they pile up."""


def count_jobs(overrides: Sequence[str]) -> int:
    """Number of jobs that overrides make.

    Examples:
        >>> count_jobs(["env=PointGoal1,CarGoal1", "seed=0,10,20", "algo=cpo"])
        6
    """
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    return math.prod(
        len(list(override.sweep_string_iterator()))
        for override in parsed
        if override.is_sweep_override()
    )


def threads_per_job(num_jobs: int, num_workers: int, num_cores: int) -> int:
    """Threads with which jobs do not get in each other's way.

    Args:
        num_jobs: Jobs of the sweep.
        num_workers: Jobs at a time; negative counts from the number of cores, -1 being all, as
            joblib has it.
        num_cores: Cores of the machine.

    Examples:
        >>> threads_per_job(num_jobs=6, num_workers=-1, num_cores=64)
        10
    """
    workers = num_workers if num_workers > 0 else num_cores + 1 + num_workers
    return max(1, num_cores // max(1, min(workers, num_jobs)))


class SweepReport(Callback):
    """Keeps a failing job from ending the sweep, and names it at the end.

    Every job leaves lines in a journal below the sweep's folder; a failing one also its traceback
    in its own. In single runs this does nothing.
    """

    def __init__(self) -> None:
        self._journal: Path | None = None
        self._num_jobs = 0
        self._process = os.getpid()
        self._modules: list[str] = []  # jobs run in processes that get this object
        self._display: _Display | None = None

    def __getstate__(self) -> dict[str, Any]:
        """What jobs in other processes get: all but what shows them."""
        return {**vars(self), "_display": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Import the user's modules in a job's process, which gets this before it composes."""
        vars(self).update(state)
        import_modules(self._modules)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Share the cores out among the jobs and begin the journal."""
        self._num_jobs = count_jobs(config.hydra.overrides.task)
        self._modules = imported()
        self._journal = _journal_path(Path(config.hydra.sweep.dir))
        num_workers = config.hydra.launcher.get("n_jobs")
        if num_workers is not None:
            num_cores = len(os.sched_getaffinity(0))
            threads = threads_per_job(self._num_jobs, num_workers, num_cores)
            os.environ["SAFE_RL_NUM_THREADS"] = str(threads)
            # bars of several jobs would overwrite each other
            os.environ.setdefault("TQDM_DISABLE", "1")
        if config.hydra.launcher.get("_target_", _IN_TURN) != _IN_TURN:
            self._display = _Display(self._journal, self._num_jobs)
            self._display.start()
        # if the launcher itself fails, Hydra does not come to the end of the sweep
        atexit.register(self._print_summary)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Note that a job has begun."""
        self._note(config, "begun")
        if os.getppid() == self._process:
            # else it would train on, or wait for ever, when the sweep was killed
            end_with_parent(_GRACE)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Note how a job has ended, and take its error out of the way of the others."""
        if self._journal is None:
            return
        failure = RunFolder(Path(config.hydra.runtime.output_dir)).failure
        error = job_return._return_value if job_return.status is JobStatus.FAILED else None
        if not isinstance(error, RunInUseError):  # the folder is somebody else's
            failure.unlink(missing_ok=True)
            if error is not None:
                replace_text(failure, "".join(traceback.format_exception(error)))
        if error is None:
            self._note(config, "done")
            return
        summary = str(error).strip().partition("\n")[0]
        self._note(config, "failed", f"{type(error).__name__}: {summary}")
        job_return.return_value, job_return.status = None, JobStatus.COMPLETED

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Say what became of the jobs; exit with status 1 if one failed."""
        atexit.unregister(self._print_summary)
        if self._print_summary():
            raise SystemExit(1)

    def _note(self, config: DictConfig, event: str, error: str = "") -> None:
        if self._journal is None:
            return
        directory = config.hydra.runtime.output_dir
        line = json.dumps({"job": config.hydra.job.num, "event": event, "error": error,
                           "directory": directory})  # fmt: skip
        # appended in one piece, also by several processes
        with self._journal.open("a") as file:
            file.write(f"{line}\n")

    def _print_summary(self) -> bool:
        """Print how the jobs ended; returns whether one is not finished."""
        assert self._journal is not None
        if self._display is not None:
            self._display.stop()
            self._display = None
        last = _last_notes(self._journal)
        done = [note for note in last.values() if note["event"] == "done"]
        print(f"Sweep: {len(done)} of {self._num_jobs} runs are finished.")
        for note in last.values():
            if note["event"] == "failed":
                file = RunFolder(Path(note["directory"])).failure
                hint = f" (see {file.name} there)" if file.exists() else ""
                print(f"  failed: {note['directory']}: {note['error']}{hint}")
            if note["event"] == "begun":
                print(f"  interrupted: {note['directory']}")
        if len(done) < self._num_jobs:
            print("Start it again as it was: finished runs are skipped, the others continue.")
        return len(done) < self._num_jobs


def _journal_path(sweep_directory: Path) -> Path:
    folder = sweep_directory / "sweeps"
    folder.mkdir(parents=True, exist_ok=True)
    return (folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{os.getpid()}.jsonl").absolute()


class Progress(NamedTuple):
    """How far a run is.

    Attributes:
        steps: Environment steps so far.
        frames: Environment steps after which it ends.
        speed: Steps per second of the last epoch.
        figures: What its own bar would show: return, costs against their limits, λ.
    """

    steps: int
    frames: int
    speed: float
    figures: Mapping[str, str]

    def __str__(self) -> str:
        """One line of a log."""
        if not self.steps:
            return "its first epoch"
        figures = ", ".join(f"{name}={value}" for name, value in self.figures.items())
        share = f"{self.steps / max(1, self.frames):.0%} of {self.frames:,} steps"
        return ", ".join(filter(None, [share, f"{self.speed:,.0f} steps/s", figures]))


def progress_of(directory: Path) -> Progress:
    """How far the run in a folder is; 0 steps of 0 if it has not finished an epoch.

    Examples:
        >>> progress_of(getfixture("tiny_run").directory)[:2]
        (80, 80)
        >>> progress_of(Path("/nowhere"))[:2]
        (0, 0)
    """
    folder = RunFolder(directory)
    with suppress(OSError, ValueError, LookupError, TypeError):
        config, row = read_config(folder.config), last_row(folder.table)
        limits = {key: float(limit) for key, limit in (config["cost_limits"] or {}).items()}
        speed, figures = row["steps_per_second"], shown(row, limits)
        return Progress(int(row["steps"]), int(config["frames"]), speed, figures)
    return Progress(0, 0, 0.0, {})


def _last_notes(journal: Path) -> dict[int, Mapping[str, str]]:
    """Number of a job -> the last note on it in the sweep's journal."""
    notes = {}
    with suppress(OSError):
        for line in journal.read_text().splitlines():
            with suppress(ValueError):  # of a line that is being written
                note = json.loads(line)
                notes[note["job"]] = note
    return notes


class _Display:
    """A bar for each run at hand; where no bar can be drawn, a line for each every minute.

    Args:
        journal: The sweep's journal.
        num_jobs: Jobs of the sweep.
        stream: Where to show it.
    """

    def __init__(self, journal: Path, num_jobs: int, stream: TextIO | None = None) -> None:
        self._journal, self._num_jobs = journal, num_jobs
        self._stream = sys.stderr if stream is None else stream
        self._draws = self._stream.isatty()
        self._bars: dict[Path | None, tqdm] = {}  # of a run, None for the sweep
        self._end = Event()
        self._thread = Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        """Begin to show, beside what this process does."""
        self._thread.start()

    def stop(self) -> None:
        """Show no more, and leave the lines to others."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        for bar in self._bars.values():
            bar.close()
        self._bars = {}

    def _watch(self) -> None:
        while not self._end.wait(_SECONDS if self._draws else _SECONDS_OF_A_LOG):
            self.show()

    def show(self) -> None:
        """Show once how far everything is."""
        notes = _last_notes(self._journal).values()
        begun = [Path(note["directory"]) for note in notes if note["event"] == "begun"]
        running = {directory: progress_of(directory) for directory in begun}
        if not self._draws:
            for directory, progress in running.items():
                print(f"{self._name(directory)}: {progress}", file=self._stream, flush=True)
            return
        for gone in [d for d in self._bars if d is not None and d not in running]:
            self._bars.pop(gone).close()
        whole = self._bar(None, "sweep", total=self._num_jobs, unit=" runs")
        whole.update(len(notes) - len(running) - whole.n)
        whole.refresh()
        for directory, progress in running.items():
            bar = self._bar(directory, self._name(directory), unit=" steps", unit_scale=True)
            if progress.steps and not bar.n:
                # what was there before, of a run that is continued say, took none of this time
                bar.reset(progress.frames)
                bar.initial = bar.n = progress.steps
            bar.set_postfix(progress.figures, refresh=False)
            bar.update(progress.steps - bar.n)
            bar.refresh()

    def _bar(self, key: Path | None, name: str, **settings: Any) -> tqdm:
        if key not in self._bars:
            taken = {-bar.pos for bar in self._bars.values()}
            place = next(number for number in count() if number not in taken)
            self._bars[key] = tqdm(
                desc=name, position=place, file=self._stream, leave=False, dynamic_ncols=True,
                smoothing=0.1, disable=False, **settings,
            )  # fmt: skip
        return self._bars[key]

    def _name(self, directory: Path) -> str:
        """A run's folder, from that of the sweep on."""
        above = self._journal.parent.parent
        return str(directory.relative_to(above) if above in directory.parents else directory)
