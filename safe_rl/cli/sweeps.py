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
from pathlib import Path
from threading import Event, Thread
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from safe_rl.cli.grammar import parse
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


def count_jobs(overrides: Sequence[str]) -> int:
    """Number of jobs that overrides make.

    Examples:
        >>> count_jobs(["env=PointGoal1,CarGoal1", "seed=0,10,20", "algo=cpo"])
        6
    """
    swept = (override for override in map(parse, overrides) if override.is_discrete_sweep())
    return math.prod(len(list(override.sweep_string_iterator())) for override in swept)


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
        trials = config.hydra.sweeper.get("n_trials")  # of a sweeper that chooses the values
        self._num_jobs = trials or count_jobs(config.hydra.overrides.task)
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
            self._display = _Display(self._journal)
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
        # as a sweeper that optimises takes it
        job_return.return_value, job_return.status = -math.inf, JobStatus.COMPLETED

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
        last = _last_notes(self._journal).values()
        num_done = sum(note["event"] == "done" for note in last)
        print(f"Sweep: {num_done} of {self._num_jobs} runs are finished.")
        for note in last:
            if note["event"] == "failed":
                file = RunFolder(Path(note["directory"])).failure
                hint = f" (see {file.name} there)" if file.exists() else ""
                print(f"  failed: {note['directory']}: {note['error']}{hint}")
            if note["event"] == "begun":
                print(f"  interrupted: {note['directory']}")
        if num_done < self._num_jobs:
            print("Start it again as it was: finished runs are skipped, the others continue.")
        return num_done < self._num_jobs


def _journal_path(sweep_directory: Path) -> Path:
    folder = sweep_directory / "sweeps"
    folder.mkdir(parents=True, exist_ok=True)
    return (folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{os.getpid()}.jsonl").absolute()


def progress_of(directory: Path) -> str:
    """How far the run in a folder is, in a line.

    Examples:
        >>> progress_of(getfixture("tiny_run").directory)[:17]
        '100% of 80 steps,'
        >>> progress_of(Path("/nowhere"))
        'its first epoch'
    """
    folder = RunFolder(directory)
    with suppress(OSError, ValueError, LookupError, TypeError):
        config, row = read_config(folder.config), last_row(folder.table)
        limits = {key: float(limit) for key, limit in (config["cost_limits"] or {}).items()}
        share, speed = row["steps"] / config["frames"], row["steps_per_second"]
        figures = [f"{name}={value}" for name, value in shown(row, limits).items()]
        done = f"{share:.0%} of {config['frames']:,} steps"
        return ", ".join([done, f"{speed:,.0f} steps/s", *figures])
    return "its first epoch"


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
    """Prints every minute how far each unfinished run is, in a thread of its own."""

    def __init__(self, journal: Path, seconds: float = 60.0) -> None:
        self._journal, self._seconds, self._end = journal, seconds, Event()
        self._thread = Thread(target=self._watch, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Print no more."""
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        sweep = self._journal.parent.parent
        while not self._end.wait(self._seconds):
            for note in _last_notes(self._journal).values():
                if note["event"] == "begun":
                    path = Path(note["directory"])
                    name = path.relative_to(sweep) if sweep in path.parents else path
                    print(f"{name}: {progress_of(path)}", file=sys.stderr, flush=True)
