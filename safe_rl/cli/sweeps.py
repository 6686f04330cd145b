"""Sweeps of many runs: the threads of each job, and a log of how each has ended."""

from __future__ import annotations

import json
import math
import os
import traceback
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from safe_rl.cli.grammar import parse
from safe_rl.cli.user_code import import_modules, imported
from safe_rl.envs import store_configs
from safe_rl.files import replace_text
from safe_rl.processes import end_with_parent
from safe_rl.runs.display import LINE_SECONDS
from safe_rl.runs.folder import RunInUseError
from safe_rl.runs.run import Run

_GRACE = 30.0
"""Seconds in which a job whose sweep was killed may end its epoch and write a checkpoint."""


def count_jobs(overrides: Sequence[str]) -> int:
    """Number of jobs that overrides make."""
    swept = (override for override in map(parse, overrides) if override.is_discrete_sweep())
    return math.prod(len(list(override.sweep_string_iterator())) for override in swept)


class Sweep:
    """The function that Hydra's launcher calls for each job, in this process or in another one.

    A failing job does not end the sweep: its traceback is written into its folder. Every job writes
    into a log below the sweep's folder when it begins and how it ends.

    Args:
        hydra: The node ``hydra`` of the first job.
        overrides: Overrides of the whole sweep.
    """

    def __init__(self, hydra: DictConfig, overrides: Sequence[str]) -> None:
        # a sweeper that chooses values itself has a number of trials
        self._num_jobs = hydra.sweeper.get("n_trials") or count_jobs(overrides)
        self._modules = imported()
        self._process = os.getpid()
        folder = Path(hydra.sweep.dir).absolute() / "sweeps"
        folder.mkdir(parents=True, exist_ok=True)
        self._log = folder / f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{self._process}.jsonl"
        num_workers = hydra.launcher.get("n_jobs")
        if num_workers is not None:
            import joblib  # it comes with this launcher

            # all jobs together use the cores once
            at_a_time = min(joblib.effective_n_jobs(num_workers), self._num_jobs)
            threads = max(1, joblib.cpu_count() // at_a_time)
            os.environ["SAFE_RL_NUM_THREADS"] = str(threads)
            # bars of several jobs would overwrite each other
            os.environ.setdefault(LINE_SECONDS, "60")

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Import the user's modules in a job's process, before Hydra composes the job there."""
        vars(self).update(state)
        store_configs()
        import_modules(self._modules)

    def __call__(self, config: DictConfig) -> float:
        """Run a job; return the value that a sweeper maximises, −∞ if the job has failed."""
        from safe_rl.cli.session import run_job  # with torch: a sweep is checked without it

        hydra = cast(DictConfig, HydraConfig.get())
        folder = Run(Path(hydra.runtime.output_dir))
        self._note(hydra, "interrupted")  # unless another line follows
        if os.getppid() == self._process:
            # otherwise the job would go on, or wait for ever, after the sweep was killed
            end_with_parent(_GRACE)
        try:
            value = run_job(config, hydra)
        except Exception as error:
            summary = f"{type(error).__name__}: {str(error).strip().partition(chr(10))[0]}"
            if not isinstance(error, RunInUseError):  # then another process owns the folder
                folder.directory.mkdir(parents=True, exist_ok=True)
                replace_text(folder.failure_file, "".join(traceback.format_exception(error)))
                summary += f" (see {folder.failure_file.name} there)"
            self._note(hydra, "failed", f": {summary}")
            return -math.inf
        folder.failure_file.unlink(missing_ok=True)
        self._note(hydra, "done")
        return value

    def _note(self, hydra: DictConfig, state: str, error: str = "") -> None:
        note = [hydra.job.num, state, hydra.runtime.output_dir + error]
        # one write per line: several processes append to the file
        with self._log.open("a") as file:
            file.write(json.dumps(note) + "\n")

    def print_summary(self) -> bool:
        """Print how the jobs have ended; return whether all are finished."""
        lines = self._log.read_text().splitlines() if self._log.exists() else []
        last = {job: (state, words) for job, state, words in map(json.loads, lines)}.values()
        num_done = sum(state == "done" for state, _ in last)
        print(f"Sweep: {num_done} of {self._num_jobs} runs are finished.")
        for state, words in last:
            if state != "done":
                print(f"  {state}: {words}")
        if num_done < self._num_jobs:
            print("Start it again as it was: finished runs are skipped, the others continue.")
        return bool(num_done >= self._num_jobs)
