"""A command that is interrupted says so in a line."""

from __future__ import annotations

import os
import sys
from types import TracebackType

__all__ = ["say_if_heard", "say_interruptions"]


def say_if_heard(*lines: str) -> None:
    """Print lines, unless their terminal was closed, which may be what has ended the run."""
    try:
        for line in lines:
            print(line)
    except OSError:
        # what is left unsaid would be tried again at the very end, and change the exit status
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115


def say_interruptions() -> None:
    """Let Ctrl-C print a word instead of a traceback, which ``HYDRA_FULL_ERROR=1`` shows.

    The process still ends by the signal, as shells want it that run commands in a loop.
    """
    sys.excepthook = _say


def _say(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt) and os.environ.get("HYDRA_FULL_ERROR") != "1":
        print("Interrupted.", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)
