"""The folder of a run: what lies in it, and where. Nothing else spells these names."""

from __future__ import annotations

import os
import re
import shlex
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

__all__ = [
    "KINDS",
    "RunFolder",
    "checkpoint_name",
    "checkpoint_steps",
    "checkpoints_in",
    "common_source",
    "paths_below",
    "run_of",
    "runs_below",
]

_CHECKPOINT = re.compile(r"checkpoint-(\d+)\.torchrl")
KINDS = ("last", "best", "certified")
"""Folders of checkpoints: the newest few, the best that kept every limit, the certified one."""


@dataclass(frozen=True)
class RunFolder:
    """Where the files of one run are.

    Attributes:
        directory: The folder, which need not exist.

    Examples:
        >>> folder = RunFolder(Path("runs/mine"))
        >>> folder.table.as_posix(), folder.evaluation("many", "json").name
        ('runs/mine/progress.csv', 'evaluation_many.json')
        >>> folder.checkpoint("best", 3000).as_posix()
        'runs/mine/checkpoints/best/checkpoint-000000003000.torchrl'
    """

    directory: Path

    @property
    def config(self) -> Path:
        """The resolved configuration."""
        return self.directory / "config.yaml"

    @property
    def table(self) -> Path:
        """A row per epoch."""
        return self.directory / "progress.csv"

    @property
    def packed_table(self) -> Path:
        """The table of a run that is kept without what it takes to go on, compressed."""
        return self.directory / "progress.csv.gz"

    @property
    def recorded_table(self) -> Path:
        """The table as it is there: plain, or else compressed."""
        is_packed = self.packed_table.is_file() and not self.table.is_file()
        return self.packed_table if is_packed else self.table

    @property
    def curves(self) -> Path:
        """The picture of its learning curves."""
        return self.directory / "curves.png"

    @property
    def failure(self) -> Path:
        """What a job of a sweep has failed of."""
        return self.directory / "failure.txt"

    @property
    def lock(self) -> Path:
        """What keeps a second process from writing here."""
        return self.directory / ".lock"

    @property
    def writer(self) -> Path:
        """Who holds the lock."""
        return self.directory / ".writer.json"

    @property
    def robot(self) -> Path:
        """Folder with copies of the robot's files, where the robot is one of the user's own."""
        return self.directory / "robot"

    @property
    def robot_note(self) -> Path:
        """Which robot that is, and its SHA-256."""
        return self.directory / "robot.json"

    @property
    def notes(self) -> Path:
        """Folder of Hydra's notes."""
        return self.directory / ".hydra"

    @property
    def overrides(self) -> Path:
        """What the command line said."""
        return self.notes / "overrides.yaml"

    @property
    def surroundings(self) -> Path:
        """Hydra's own configuration, with the folder that the run was started in."""
        return self.notes / "hydra.yaml"

    @property
    def composed(self) -> Path:
        """The configuration before it was resolved."""
        return self.notes / "config.yaml"

    @property
    def code(self) -> Path:
        """By which code it was carried out."""
        return self.directory / "code.json"

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.directory / "checkpoints"

    def checkpoint(self, kind: str, steps: int) -> Path:
        """The checkpoint of a kind after so many environment steps."""
        return self.checkpoints / kind / checkpoint_name(steps)

    def newest_checkpoint(self, kind: str = "last") -> Path | None:
        """The checkpoint after most steps, readable or not, if there is one of that kind."""
        found = checkpoints_in(self.checkpoints / kind)
        return found[-1] if found else None

    @property
    def transitions(self) -> Path:
        """Folder of what was collected, if it was recorded."""
        return self.directory / "transitions"

    @property
    def certificate(self) -> Path:
        """Which checkpoint surely keeps the limits."""
        return self.directory / "certificate.json"

    @property
    def certifying(self) -> Path:
        """What is there from the end of training until it is found out what the run comes to."""
        return self.directory / ".certifying"

    def evaluation(self, name: str, suffix: str) -> Path:
        """What an evaluation leaves: ``json`` for estimates, ``csv``, ``mp4``, ``transitions``."""
        return self.directory / f"{'_'.join(filter(None, ('evaluation', name)))}.{suffix}"

    def variations(self, name: str, suffix: str) -> Path:
        """A file of an evaluation under variations: ``csv`` the table, ``png`` the picture."""
        return self.directory / f"{'_'.join(filter(None, ('variations', name)))}.{suffix}"

    def evaluations(self) -> list[Path]:
        """The estimates of all evaluations."""
        return sorted(self.directory.glob("evaluation*.json"))

    def logger_id(self, logger: str) -> Path:
        """Where the id of this run is kept that a logger's service has given it."""
        return self.directory / f"{logger}_run_id.txt"

    @property
    def is_run(self) -> bool:
        """Whether a run has been set up here."""
        return self.config.is_file()

    @property
    def has_begun(self) -> bool:
        """Whether a run has a table here."""
        return self.table.exists()

    @property
    def is_untouched(self) -> bool:
        """Whether nothing has been written here but what shows who would."""
        lock = (self.lock.name, self.writer.name)
        return all(path.name in lock for path in self.directory.iterdir())

    @property
    def num_rows(self) -> int:
        """Finished epochs in the table."""
        try:
            lines = self.table.read_bytes().count(b"\n")
        except FileNotFoundError:
            return 0
        return max(0, lines - 1)

    def check_is_free(self) -> None:
        """Refuse a folder in which a run has begun.

        Raises:
            FileExistsError: Saying how to go on with that run.
        """
        if self.has_begun:
            raise FileExistsError(
                f"{self.directory} already holds a run. Continue it with: python train.py "
                f"{self.resuming}; or give this one another folder with hydra.run.dir=..."
            )

    @property
    def resuming(self) -> str:
        """What goes on with the run, as a shell takes it."""
        return f"resume={shlex.quote(str(self.directory))}"

    def check_is_run(self) -> None:
        """Refuse a folder that is not a run's.

        Raises:
            FileNotFoundError: Naming runs that are below it.
        """
        if self.is_run:
            return
        below = [str(run.directory) for run in runs_below(self.directory)[:5]]
        hint = f" Runs below it: {', '.join(below)}." if below else ""
        raise FileNotFoundError(
            f"{self.directory} is not the folder of a run: no {self.config.name}.{hint}"
        )


def runs_below(root: Path) -> list[RunFolder]:
    """Folders of runs below a folder, itself included, in the order of their paths."""
    found = paths_below(root, RunFolder(root).config.name)
    notes = RunFolder(root).notes.name
    return [RunFolder(path.parent) for path in found if path.parent.name != notes]


def paths_below(root: Path, pattern: str) -> list[Path]:
    """Files and folders of such names below a folder, sorted; links to folders are not followed.

    Folders may vanish meanwhile, as those of a checkpoint that is being written do, at which
    `Path.rglob` fails.
    """
    return sorted(
        Path(folder, name)
        for folder, folders, files in os.walk(root)
        for name in (*folders, *files)
        if fnmatchcase(name, pattern)
    )


def checkpoint_name(steps: int) -> str:
    """Name of a checkpoint after so many environment steps."""
    return f"checkpoint-{steps:012d}.torchrl"


def checkpoint_steps(path: Path) -> int | None:
    """Environment steps that a checkpoint's name carries, if it is one's name.

    Examples:
        >>> checkpoint_steps(Path("last/checkpoint-000000000300.torchrl"))
        300
    """
    match = _CHECKPOINT.fullmatch(path.name)
    return None if match is None else int(match.group(1))


def checkpoints_in(directory: Path) -> list[Path]:
    """Checkpoints in a folder by ascending steps, readable or not; none if there is no folder."""
    found = directory.iterdir() if directory.is_dir() else ()
    steps = {path: checkpoint_steps(path) for path in found}
    return sorted((path for path in steps if steps[path] is not None), key=lambda p: steps[p] or 0)


def run_of(source: Path) -> tuple[Path, int | None]:
    """Folder of the run that ``init_from`` names, and steps of the checkpoint if it names one.

    Examples:
        >>> folder, steps = run_of(Path("a/checkpoints/best/checkpoint-000000003000.torchrl"))
        >>> folder.name, steps
        ('a', 3000)
    """
    steps = checkpoint_steps(source)
    if steps is None or len(source.parents) < 3:
        return source, None
    return source.parents[2], steps


def common_source(source: str) -> str:
    """What ``init_from`` is alike in over seeds, each of which starts from a run of its own.

    Examples:
        >>> common_source("runs/small/seed3")
        'runs/small'
        >>> common_source("runs/small/seed3/checkpoints/best/checkpoint-000000003000.torchrl")
        'runs/small/*/checkpoints/best'
    """
    path = Path(source)
    folder, steps = run_of(path)
    if steps is None:
        return str(folder.parent)
    checkpoint = path.relative_to(folder)
    # the best one comes after other steps in every seed
    is_best = checkpoint.parent.name == "best"
    return str(folder.parent / "*" / (checkpoint.parent if is_best else checkpoint))
