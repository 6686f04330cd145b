"""Folders of runs, names of their checkpoints, and the lock that allows one writer."""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from fnmatch import fnmatchcase
from itertools import count, islice
from pathlib import Path
from platform import node

from filelock import FileLock, Timeout

from safe_rl.files import check_no_links, read_text

_CHECKPOINT = re.compile(r"checkpoint-(\d+)\.torchrl")
# the end of the name of a run's folder, as commands make it: date, seed, number of a repetition
_OF_SEED = re.compile(r"(^\d{4}-[\d_-]+)?seed\d+(_\d+)?$")
# see `safe_rl.files.replacing`
_UNFINISHED = re.compile(r"\.[\w-]+\.[0-9a-f]{16}\.\w+")
_DAY = 86_400.0  # [s]
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)


def paths_below(root: Path, pattern: str, most: int | None = None) -> list[Path]:
    """Files and folders below a folder whose names match, sorted; of the ``most`` first folders.

    Links to folders are not followed. Folders may disappear during the search, which `Path.rglob`
    does not tolerate.
    """
    return sorted(
        Path(folder, name)
        for folder, folders, files in islice(os.walk(root), most)
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
    entries = directory.iterdir() if directory.is_dir() else ()
    return sorted(path for path in entries if checkpoint_steps(path) is not None)


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


def new_folder(wanted: Path) -> Path:
    """Make the folder of a new run; if it exists, its name gets a number."""
    wanted = wanted.expanduser().absolute()
    for number in count(1):
        path = wanted if number == 1 else wanted.with_name(f"{wanted.name}_{number}")
        with suppress(FileExistsError):  # of a run that began in the same second
            path.mkdir(parents=True)
            break
    return path


class RunInUseError(ValueError):
    """Another process writes into the folder; the message names it."""


@contextmanager
def lock_folder(file: Path) -> Iterator[None]:
    """Lock a file, to keep other processes from writing into its folder; blocks may be nested.

    Unfinished files of a process that was killed are removed.

    The lock is the kernel's (``flock``), which ends with its process. If the file system has no
    such locks, or each machine has its own, other machines are not kept from writing.

    Raises:
        RunInUseError: If another process holds the lock.
        ValueError: If the folder holds links, which could lead writing elsewhere.
    """
    directory = file.parent
    check_no_links(directory)
    # One object per file, so that this process can lock it several times. No fallback to a file:
    # after its process is killed, the file would stay, and the run could not be continued.
    place = file.resolve()
    lock = FileLock(place, 0, thread_local=False, is_singleton=True, fallback_to_soft=False)
    with ExitStack() as stack:
        try:
            stack.enter_context(lock)
            file.write_text(f"process {os.getpid()} on {node()}")
        except Timeout:
            writer = read_text(file) or "another process"
            raise RunInUseError(
                f"{directory} is being written by {writer}. Wait for it, or end it; a run that was "
                "ended is continued by resume=."
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        unfinished = paths_below(directory, ".*") if lock.lock_counter == 1 else ()
        for path in filter(is_unfinished, unfinished):
            with suppress(FileNotFoundError):
                is_old = time.time() - path.stat().st_mtime > _DAY
                # an evaluation writes without the lock: what it may be writing now stays for a day
                if is_old or not path.name.startswith(".evaluation"):
                    path.unlink()
        yield


def is_unfinished(path: Path) -> bool:
    """Whether a file is one that `safe_rl.files.replacing` has not finished to write."""
    return _UNFINISHED.fullmatch(path.name) is not None and path.is_file()
