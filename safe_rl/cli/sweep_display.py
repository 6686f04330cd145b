"""What the runs of a sweep are doing, while other processes carry them out."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread
from typing import NamedTuple, TextIO

from tqdm import tqdm

from safe_rl.runs.files import read_config
from safe_rl.runs.folder import RunFolder
from safe_rl.runs.outcome import shown
from safe_rl.runs.table import last_row

__all__ = ["Progress", "SweepDisplay", "last_notes", "progress_of"]

_SECONDS = 1.0
_SECONDS_OF_A_LOG = 60.0
"""Between two looks at the runs: where lines can be drawn anew, and where they pile up."""


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


def last_notes(journal: Path) -> dict[int, Mapping[str, str]]:
    """Number of a job -> the last note on it in the sweep's journal."""
    notes = {}
    with suppress(OSError):
        for line in journal.read_text().splitlines():
            with suppress(ValueError):  # of a line that is being written
                note = json.loads(line)
                notes[note["job"]] = note
    return notes


class SweepDisplay:
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
        self._bars: dict[Path, tqdm] = {}
        self._total: tqdm | None = None
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
        for bar in [*self._bars.values(), *filter(None, [self._total])]:
            bar.close()
        self._bars, self._total = {}, None

    def _watch(self) -> None:
        while not self._end.wait(_SECONDS if self._draws else _SECONDS_OF_A_LOG):
            self.show()

    def show(self) -> None:
        """Show once how far everything is."""
        notes = last_notes(self._journal).values()
        begun = [Path(note["directory"]) for note in notes if note["event"] == "begun"]
        running = {directory: progress_of(directory) for directory in begun}
        if self._draws:
            self._draw(running, len(notes) - len(running))
        else:
            for directory, progress in running.items():
                print(f"{self._name(directory)}: {progress}", file=self._stream, flush=True)

    def _draw(self, running: Mapping[Path, Progress], ended: int) -> None:
        if self._total is None:
            self._total = self._bar(0, "sweep", total=self._num_jobs, unit=" runs")
        self._total.update(ended - self._total.n)
        self._total.refresh()
        for gone in [directory for directory in self._bars if directory not in running]:
            self._bars.pop(gone).close()
        for directory, progress in running.items():
            if directory not in self._bars:
                taken = {-bar.pos for bar in self._bars.values()}
                place = next(n for n in range(1, len(taken) + 2) if n not in taken)
                name = self._name(directory)
                self._bars[directory] = self._bar(place, name, unit=" steps", unit_scale=True)
            self._move(self._bars[directory], progress)

    @staticmethod
    def _move(bar: tqdm, progress: Progress) -> None:
        if progress.steps and not bar.n:
            # what was there before, of a run that is continued say, took none of this time
            bar.reset(progress.frames)
            bar.initial = bar.n = progress.steps
        bar.set_postfix(progress.figures, refresh=False)
        bar.update(progress.steps - bar.n)
        bar.refresh()

    def _bar(self, place: int, name: str, **settings: object) -> tqdm:
        return tqdm(
            desc=name, position=place, file=self._stream, leave=False, dynamic_ncols=True,
            smoothing=0.1, disable=False, **settings,
        )  # fmt: skip

    def _name(self, directory: Path) -> str:
        """A run's folder, from that of the sweep on."""
        above = self._journal.parent.parent
        return str(directory.relative_to(above) if above in directory.parents else directory)
