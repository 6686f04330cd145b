"""One writer per run: a lock on its folder, which ends with the process that holds it."""

from __future__ import annotations

import errno
import json
import os
import socket
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from threading import Event, Thread
from typing import Any

from filelock import FileLock, Timeout

from safe_rl.runs.files import replace_text
from safe_rl.runs.folder import RunFolder

__all__ = ["RunInUseError", "held"]

BEAT = 5.0
"""Seconds after which a writer shows again that it is there."""

_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)
_held: dict[Path, int] = {}  # folder -> the process that holds it: not one forked from it


class RunInUseError(ValueError):
    """A folder into which another process writes; the message says which."""


@contextmanager
def held(folder: RunFolder) -> Iterator[None]:
    """Keep others from writing into a folder; inside another such block of this process, go on.

    The lock is the kernel's (``flock``, which Linux passes on to NFS servers), so that nothing has
    to be tidied up after a process that was killed. A network file system may keep such locks to
    each machine, or have none. Therefore the holder also shows every few seconds that it is there,
    and one that is found on another machine is watched before its place is taken.

    Raises:
        RunInUseError: If another process holds it.

    Examples:
        >>> import tempfile
        >>> folder = RunFolder(Path(tempfile.mkdtemp()))
        >>> with held(folder):
        ...     folder.writer.exists()
        True
        >>> folder.writer.exists()
        False
    """
    place = folder.directory.resolve()
    if _held.get(place) == os.getpid():
        yield
        return
    lock = _lock(folder)
    try:
        _check_writer(folder, is_locked=lock is not None)
        _held[place] = os.getpid()
        replace_text(folder.writer, json.dumps(_present_writer()))
        try:
            with _beating(folder.writer):
                yield
        finally:
            folder.writer.unlink(missing_ok=True)
    finally:
        _held.pop(place, None)
        if lock is not None:
            lock.release()


def _lock(folder: RunFolder) -> FileLock | None:
    """The kernel's lock on a folder; none where the file system has no locks."""
    lock = FileLock(folder.lock, blocking=False, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        raise _in_use(folder) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        warnings.warn(
            f"The file system of {folder.directory} has no locks ({error.strerror}): a second "
            "process that begins to write there at the same moment is not noticed.",
            stacklevel=4,
        )
        return None
    return lock


def _present_writer() -> dict[str, Any]:
    since = datetime.now().isoformat(" ", "seconds")
    return {"host": socket.gethostname(), "pid": os.getpid(), "since": since}


def _writer(folder: RunFolder) -> dict[str, Any]:
    """Who holds, or held, a folder; empty if that is not known."""
    with suppress(OSError, ValueError):
        writer = json.loads(folder.writer.read_text())
        return writer if isinstance(writer, dict) else {}
    return {}


def _in_use(folder: RunFolder) -> RunInUseError:
    writer = _writer(folder)
    who = "another process" if not writer else (
        f"process {writer.get('pid')} on {writer.get('host')}, since {writer.get('since')}"
    )  # fmt: skip
    return RunInUseError(
        f"{folder.directory} is being written by {who}. Wait for it, or end it; a run that was "
        "ended goes on with resume=."
    )


def _check_writer(folder: RunFolder, *, is_locked: bool) -> None:
    """Watch a writer that the lock says nothing about: does it still show that it is there?"""
    writer = _writer(folder)
    if not writer or (is_locked and writer.get("host") == socket.gethostname()):
        return
    seen = _shown(folder.writer)
    until = time.monotonic() + 3 * BEAT
    while time.monotonic() < until:
        time.sleep(BEAT / 10)
        if _shown(folder.writer) != seen and _writer(folder):
            raise _in_use(folder)


def _shown(path: Path) -> int:
    """When a file was touched last; opened for it, because network file systems remember names."""
    with suppress(OSError), path.open("rb") as file:
        return os.fstat(file.fileno()).st_mtime_ns
    return 0


@contextmanager
def _beating(path: Path) -> Iterator[None]:
    end = Event()

    def beat() -> None:
        while not end.wait(BEAT):
            with suppress(OSError):
                os.utime(path)

    Thread(target=beat, name="writer of a run", daemon=True).start()
    try:
        yield
    finally:
        end.set()
