"""Child processes that end with their parent, and leave signals to it.

In `safe_rl` itself, because sweeps, collectors and environments start processes.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from threading import Thread

__all__ = ["end_with_parent", "leave_signals_to_parent", "starting_processes"]

_LOOK = 1.0
"""Seconds between checks of the parent."""
_watching: set[int] = set()  # ids of this process and its ancestors that watch their parent


def end_with_parent(grace: float = 0.0) -> None:
    """End this process when its parent has ended for any reason.

    Args:
        grace: Seconds for the run at hand, which gets SIGTERM, to write its checkpoint.
    """
    if os.getpid() in _watching:
        return
    _watching.add(os.getpid())
    parent = os.getppid()

    def watch() -> None:
        # an orphan gets another parent
        while os.getppid() == parent:
            time.sleep(_LOOK)
        # a second SIGTERM would end at once a run that is ending already
        if grace and callable(signal.getsignal(signal.SIGTERM)):
            os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(grace)
        os._exit(1)

    Thread(target=watch, name="end with parent", daemon=True).start()


@contextmanager
def starting_processes() -> Iterator[None]:
    """Keep SIGINT, SIGTERM and SIGHUP from processes that this thread starts meanwhile.

    Ctrl-C, the end of a terminal, and what ends the jobs of a cluster, reach all processes of a
    run; the first process reacts to them. The others, which take seconds to start, would be ended.
    They keep these signals waiting until they call :func:`leave_signals_to_parent`.
    """
    # started later, with the first process, it would unblock signals
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(
        signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    )
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_signals_to_parent() -> None:
    """End with the parent, or by its SIGTERM; pass over SIGINT, SIGHUP and SIGTERM of others.

    To be called in the main thread of a process that was begun within :func:`starting_processes`.
    Where the system does not tell the sender of a signal (macOS), any SIGTERM ends it.
    """
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    parent = os.getppid()
    end_with_parent()
    if not hasattr(signal, "sigwaitinfo"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        return
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})

    def wait() -> None:
        while signal.sigwaitinfo({signal.SIGTERM}).si_pid != parent:
            pass
        os._exit(128 + signal.SIGTERM)

    Thread(target=wait, name="wait for the parent's order", daemon=True).start()
