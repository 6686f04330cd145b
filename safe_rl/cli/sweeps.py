"""The jobs of a sweep, and the summary at its end.

A job whose folder holds a finished run is skipped, one with checkpoints goes on, and one that fails
leaves its message in its folder while the others run.
"""

from __future__ import annotations

import json
import math
import os
import sys
import traceback
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.conf import HydraConf
from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.config import check_settings
from safe_rl.cli.folders import name_choices
from safe_rl.files import replace_text
from safe_rl.runs.folder import RunInUseError
from safe_rl.runs.identity import differences, is_to_keep_limits
from safe_rl.runs.run import Run
from safe_rl.runs.table import violation
from safe_rl.trust import import_modules

_GRACE = 30.0
"""Seconds in which a job whose sweep was killed may end its epoch and write a checkpoint."""

_failed: set[str] = set()  # folders of the jobs of this process that have failed


def run_in_sweep(config: DictConfig, settings: HydraConf, directory: Path) -> float:
    """Begin or continue the run of one job; a failure is written into its folder.

    The value is that of `run_job`, which an optimising sweeper maximises; −∞ if the job fails.
    """
    run = Run(directory)
    _failed.discard(str(directory))
    try:
        import_modules(config.get("import"))
        name_choices(config, settings)
        check_settings(config)
        value = run_job(config, settings, run)
    except Exception as error:
        summary = f"{type(error).__name__}: {' '.join(str(error).split())}"
        print(f"{directory}: {summary}", file=sys.stderr)
        _failed.add(str(directory))
        if not isinstance(error, RunInUseError):  # then another process owns the folder
            run.directory.mkdir(parents=True, exist_ok=True)
            text = "".join(traceback.format_exception(error))
            replace_text(run.failure_file, f"{summary}\n\n{text}")
        return -math.inf
    run.failure_file.unlink(missing_ok=True)
    return value


def run_job(config: DictConfig, settings: HydraConf, run: Run) -> float:
    """Train the run of a job; a finished one is skipped, an interrupted one goes on.

    The value is the run's final return, or −∞ if it ends above a limit or no episode has ended.
    """
    from safe_rl.training.train import complete, train  # with torch: a sweep starts without it

    if run.is_run:
        complete(config, run)
        check_same_run(config, run)
    train(config, run.directory, hydra=settings, continues=True)
    # without an algorithm that keeps them, costs are only recorded
    figures, limits = run.final, run.cost_limits if is_to_keep_limits(config) else {}
    value = figures["episode_return"]
    is_above = any(violation(figures, key, limit) > 0 for key, limit in limits.items())
    return -math.inf if is_above or math.isnan(value) else value


def check_same_run(config: DictConfig, run: Run) -> None:
    """Refuse, by a ValueError, to continue a run with other settings but length and machine."""
    given: Any = OmegaConf.to_container(config, resolve=True)
    if changed := differences(run.settings, given):
        changes = ", ".join(f"{key}: {before} -> {now}" for key, (before, now) in changed.items())
        raise ValueError(
            f"{run.directory} holds a run with other settings ({changes}). Move it away, or give "
            "the sweep another folder with hydra.sweep.dir=..."
        )


class Summary(Callback):
    """Prints at the end of a sweep how its jobs have ended; a callback of Hydra.

    Args:
        log: File to which every job appends a line when it begins and when it ends.
    """

    def __init__(self, log: str) -> None:
        self._log, self._process = Path(log).absolute(), os.getpid()

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Let jobs at a time share the cores."""
        if not config.hydra.sweep.dir:
            # of other errors Hydra would only warn
            sys.exit("hydra.sweep.dir= is empty: it names the folder of the sweep.")
        self._log.parent.mkdir(parents=True, exist_ok=True)
        workers = config.hydra.launcher.get("n_jobs")
        if workers is not None:
            import joblib  # it comes with this launcher

            from safe_rl.runs.progress_bar import LINE_SECONDS

            threads = max(1, joblib.cpu_count() // joblib.effective_n_jobs(workers))
            os.environ["SAFE_RL_NUM_THREADS"] = str(threads)
            # bars of several jobs would overwrite each other
            os.environ.setdefault(LINE_SECONDS, "60")

    def on_job_start(self, config: DictConfig, **_: Any) -> None:
        """Note that a job has begun; another line follows unless it is interrupted."""
        if config.hydra.mode == RunMode.MULTIRUN:
            # joblib's jobs are children of the sweep, which may have been killed before this
            if os.getpid() != self._process and "n_jobs" in config.hydra.launcher:
                from safe_rl.collectors.workers import end_with_parent  # with torch

                # otherwise the job would go on, or wait for ever, after the sweep was killed
                end_with_parent(_GRACE, self._process)
            self._note(config, "interrupted")

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """Note how a job has ended."""
        if config.hydra.mode == RunMode.MULTIRUN:
            # a job that fails returns a number to the sweeper
            has_failed = config.hydra.runtime.output_dir in _failed
            self._note(config, "failed" if has_failed else "done")

    def _note(self, config: DictConfig, state: str) -> None:
        # one write per line: several processes append to the file
        with suppress(OSError), self._log.open("a") as file:
            note = [config.hydra.job.num, state, config.hydra.runtime.output_dir]
            file.write(json.dumps(note) + "\n")

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Print how the jobs have ended; the status is 0 only if all runs are finished."""
        lines = self._log.read_text().splitlines() if self._log.exists() else []
        last = {job: (state, place) for job, state, place in map(json.loads, lines)}.values()
        if not last:
            sys.exit("The sweep has no runs: a glob(…) or range(…) in it is empty.")
        unfinished = [f"  {state}: {place}" for state, place in last if state != "done"]
        if shared := [place for place, jobs in Counter(p for _, p in last).items() if jobs > 1]:
            print(
                f"Several jobs have the folder {shared[0]}, in which only the first has trained: "
                "what they differ in is not in its name. To train all of them: "
                "hydra.sweep.subdir='my_sweep/${hydra.job.num}'"
            )
        print(f"Sweep: {len(last) - len(unfinished)} of {len(last)} runs are finished.")
        if unfinished:
            print(*unfinished, sep="\n")
            print("Start it again as it was: finished runs are skipped, the others continue.")
            sys.exit(1)
