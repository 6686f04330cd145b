"""Processes that end with the one that has started them.

It stands on the top floor because sweeps and collectors start processes, and neither room may know
the other.
"""

from __future__ import annotations

import os
import signal
import time
from threading import Thread

__all__ = ["end_with_parent", "is_stopped"]

_LOOK = 1.0
"""Seconds between looks at the parent."""
_watching: set[int] = set()  # processes that do, of this one and those it was forked from


def end_with_parent(grace: float = 0.0) -> None:
    """End this process when its parent has ended, however that was ended.

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
        # a second one would end at once the run that is ending already
        if grace and callable(signal.getsignal(signal.SIGTERM)):
            os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(grace)
        os._exit(1)

    Thread(target=watch, name="end with parent", daemon=True).start()


def is_stopped(pid: int) -> bool:
    """Whether a process stands still (SIGSTOP); False where the system does not tell."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            # the second field is a name in parentheses, which may hold anything
            return file.read().rpartition(")")[2].split()[0] in "Tt"
    except (OSError, IndexError):
        return False
