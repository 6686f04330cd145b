"""The folder of a run: names of its files, and the lock that allows one writer.

No other module contains these names.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from platform import node

from filelock import FileLock, Timeout

from safe_rl.files import check_no_links

_CHECKPOINT = re.compile(r"checkpoint-(\d+)\.torchrl")
# the end of the name of a run's folder, as commands make it: date, seed, number of a repetition
_OF_SEED = re.compile(r"(^\d{4}-[\d_-]+)?seed\d+(_\d+)?$")
KINDS = ("last", "best", "certified")
"""Folders of checkpoints: the newest, the best that kept every limit, the certified one."""

_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)


class _Below:
    """A file or folder of a run: ``folder.table`` is its path, ``RunFolder.table`` its name."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, run: RunFolder | None, kind: type[RunFolder]) -> Path:
        return Path(self._name) if run is None else run.directory / self._name


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

    config = _Below("config.yaml")  # resolved
    table = _Below("progress.csv")  # a row per epoch
    curves = _Below("curves.png")  # the picture of its learning curves
    failure = _Below("failure.txt")  # traceback of a failed job of a sweep
    lock = _Below(".lock")  # keeps a second process from writing here; names the first
    robot = _Below("robot")  # copies of the files of a user's own robot
    robot_note = _Below("robot.json")  # which robot that is, and its SHA-256
    notes = _Below(".hydra")  # Hydra's notes
    overrides = _Below(".hydra/overrides.yaml")  # overrides of the command line
    surroundings = _Below(".hydra/hydra.yaml")  # Hydra's settings, and where the command was run
    composed = _Below(".hydra/config.yaml")  # the configuration before it was resolved
    code = _Below("code.json")  # versions of the code
    checkpoints = _Below("checkpoints")  # a folder for each of `KINDS`
    transitions = _Below("transitions")  # collected transitions, if they were recorded
    certificate = _Below("certificate.json")  # which checkpoint is certified
    certifying = _Below(".certifying")  # exists between training and certificate

    def checkpoint(self, kind: str, steps: int) -> Path:
        """Path of the checkpoint of a kind with this number of environment steps."""
        return self.checkpoints / kind / checkpoint_name(steps)

    def newest_checkpoint(self, kind: str = "last") -> Path | None:
        """The checkpoint of a kind with most steps, readable or not; None if there is none."""
        found = checkpoints_in(self.checkpoints / kind)
        return found[-1] if found else None

    def evaluation(self, name: str, suffix: str) -> Path:
        """A file of an evaluation, by its suffix: ``json``, ``csv``, ``mp4``, ``transitions``."""
        return self.directory / f"{'_'.join(filter(None, ('evaluation', name)))}.{suffix}"

    def variations(self, name: str, suffix: str) -> Path:
        """A file of an evaluation under variations: ``csv`` the table, ``png`` the picture."""
        return self.directory / f"{'_'.join(filter(None, ('variations', name)))}.{suffix}"

    def evaluations(self) -> list[Path]:
        """The files with the estimates of all evaluations."""
        return sorted(self.directory.glob("evaluation*.json"))

    def logger_id(self, logger: str) -> Path:
        """The file with the id of this run in a logger's service."""
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
    def num_rows(self) -> int:
        """Finished epochs in the table."""
        try:
            lines = self.table.read_bytes().count(b"\n")
        except FileNotFoundError:
            return 0
        return max(0, lines - 1)

    def check_is_run(self) -> None:
        """Refuse a folder that is not a run's.

        Raises:
            FileNotFoundError: If it is not; the message names runs below the folder.
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
    found = paths_below(root, RunFolder.config.name)
    return [RunFolder(path.parent) for path in found if path.parent.name != RunFolder.notes.name]


def paths_below(root: Path, pattern: str) -> list[Path]:
    """Files and folders below a folder whose names match, sorted.

    Links to folders are not followed. Folders may disappear during the search, which `Path.rglob`
    does not tolerate.
    """
    return sorted(
        Path(folder, name)
        for folder, folders, files in os.walk(root)
        for name in (*folders, *files)
        if fnmatchcase(name, pattern)
    )


def checkpoint_name(steps: int) -> str:
    """File name of a checkpoint with this number of environment steps."""
    return f"checkpoint-{steps:012d}.torchrl"


def checkpoint_steps(path: Path) -> int | None:
    """Environment steps in the name of a checkpoint; None if it is another file.

    Examples:
        >>> checkpoint_steps(Path("last/checkpoint-000000000300.torchrl"))
        300
    """
    match = _CHECKPOINT.fullmatch(path.name)
    return None if match is None else int(match.group(1))


def checkpoints_in(directory: Path) -> list[Path]:
    """Checkpoints in a folder by ascending steps, readable or not; none if there is no folder."""
    found = directory.iterdir() if directory.is_dir() else ()
    return sorted(path for path in found if checkpoint_steps(path) is not None)


def run_of(source: Path) -> tuple[Path, int | None]:
    """Folder of the run that ``init_from`` names, and the steps if it names a checkpoint.

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
    """The part of ``init_from`` that all seeds share; a folder without a seed in its name stays.

    Examples:
        >>> common_source("runs/small/seed3"), common_source("runs/small_seed3")
        ('runs/small', 'runs/small_*')
        >>> common_source("runs/small")
        'runs/small'
        >>> common_source("runs/small/seed3/checkpoints/best/checkpoint-000000003000.torchrl")
        'runs/small/*/checkpoints/best'
    """
    path = Path(source)
    folder, steps = run_of(path)
    shared = folder.parent / _OF_SEED.sub("*", folder.name)
    if steps is None:
        return str(folder.parent if shared.name == "*" else shared)
    checkpoint = path.relative_to(folder)
    # the steps of the best one differ between seeds
    is_best = checkpoint.parent.name == "best"
    return str(shared / (checkpoint.parent if is_best else checkpoint))


class RunInUseError(ValueError):
    """Another process writes into the folder; the message names it."""


@contextmanager
def lock_folder(folder: RunFolder) -> Iterator[None]:
    """Keep other processes from writing into a folder; such blocks may be nested.

    The lock is the kernel's (``flock``), which ends with its process. If the file system has no
    such locks, or each machine has its own, other machines are not kept from writing.

    Raises:
        RunInUseError: If another process holds the lock.
        ValueError: If the folder holds links, which could lead writing elsewhere.
    """
    check_no_links(folder.directory)
    # One object per file, so that this process can lock it several times. No fallback to a file:
    # after its process is killed, the file would stay, and the run could not be continued.
    place = folder.lock.resolve()
    lock = FileLock(place, 0, thread_local=False, is_singleton=True, fallback_to_soft=False)
    with ExitStack() as stack:
        try:
            stack.enter_context(lock)
            folder.lock.write_text(f"process {os.getpid()} on {node()}")
        except Timeout:
            writer = folder.lock.read_text() or "another process"
            raise RunInUseError(
                f"{folder.directory} is being written by {writer}. Wait for it, or end it; a run "
                "that was ended is continued by resume=."
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        yield
