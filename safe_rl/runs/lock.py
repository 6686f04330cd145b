"""One writer per run: a lock on its folder, which ends with the process that holds it."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, SoftFileLease, Timeout

from safe_rl.runs.folder import RunFolder

__all__ = ["RunInUseError", "held"]

LEASE = 15.0
"""Seconds after which a writer on another machine that has not renewed its lease is gone."""

_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP)
_held: dict[Path, int] = {}  # folder -> the process that holds it: not one forked from it


class RunInUseError(ValueError):
    """A folder into which another process writes; the message says which."""


@contextmanager
def held(folder: RunFolder) -> Iterator[None]:
    """Keep others from writing into a folder; inside another such block of this process, go on.

    Two locks of `filelock`'s: the kernel's (``flock``), which nobody has to tidy up after a process
    that was killed, and a lease, because network file systems may keep the kernel's to each machine
    or have none. The lease of a writer on another machine counts until it has not been renewed for
    `LEASE` seconds.

    Raises:
        RunInUseError: If another process holds it.

    Examples:
        >>> import tempfile
        >>> folder = RunFolder(Path(tempfile.mkdtemp()))
        >>> with held(folder):
        ...     folder.lease.exists()
        True
        >>> folder.lease.exists()
        False
    """
    place = folder.directory.resolve()
    if _held.get(place) == os.getpid():
        yield
        return
    lease = SoftFileLease(folder.lease, lease_duration=LEASE, thread_local=False)
    with ExitStack() as stack:
        try:
            _lock(folder, lease, stack)
            stack.enter_context(lease.acquire(timeout=2 * LEASE))
        except Timeout:
            raise _in_use(folder, lease) from None
        _held[place] = os.getpid()
        stack.callback(_held.pop, place)
        yield


def _lock(folder: RunFolder, lease: SoftFileLease, stack: ExitStack) -> None:
    """Take the kernel's lock, where the file system has locks."""
    try:
        stack.enter_context(FileLock(folder.lock, blocking=False, thread_local=False))
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return
    if lease.owner is None:  # of a machine that went down while it was written
        folder.lease.unlink(missing_ok=True)


def _in_use(folder: RunFolder, lease: SoftFileLease) -> RunInUseError:
    owner = lease.owner
    # behind the name of the machine is that of the container
    machine = "" if owner is None else owner.hostname.partition("?")[0]
    who = "another process" if owner is None else f"process {owner.pid} on {machine}"
    return RunInUseError(
        f"{folder.directory} is being written by {who}. Wait for it, or end it; a run that was "
        "ended goes on with resume=."
    )
