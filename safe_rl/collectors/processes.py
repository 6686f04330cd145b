"""Child processes that end with their parent, and leave signals to it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from threading import Thread

_LOOK = 1.0
"""Seconds between checks of the parent."""
_watching: set[int] = set()  # ids of this process and its ancestors that watch their parent


def end_with_parent(grace: float = 0.0) -> None:
    """End this process when its parent has ended for any reason.

    Args:
        grace: Seconds that a run in this process has to write its checkpoint after SIGTERM.
    """
    if os.getpid() in _watching:
        return
    _watching.add(os.getpid())
    parent = os.getppid()

    def watch() -> None:
        # when the parent ends, this process gets another one
        while os.getppid() == parent:
            time.sleep(_LOOK)
        # not if a first SIGTERM has restored the default: a second one would end the run at once
        if grace and callable(signal.getsignal(signal.SIGTERM)):
            os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(grace)
        os._exit(1)

    Thread(target=watch, name="end with parent", daemon=True).start()


@contextmanager
def starting_processes() -> Iterator[None]:
    """Block SIGINT, SIGTERM and SIGHUP in processes that this thread starts within the block.

    These signals reach all processes of a run: by Ctrl-C, by the end of a terminal, or from the
    scheduler of a cluster. Only the first process should react to them, but they would end the
    others while these start. The others block them until `leave_signals_to_parent`.
    """
    # started later, together with the first process, the tracker would unblock the signals
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(
        signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    )
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_signals_to_parent() -> None:
    """Let this process end when its parent ends or sends SIGTERM, and ignore other signals.

    The other signals are SIGINT, SIGHUP, and SIGTERM from any other process. Call this function in
    the main thread of a process that was started within `starting_processes`. Where the
    system does not tell the sender of a signal (macOS), any SIGTERM ends the process.
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
