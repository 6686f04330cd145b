"""What a person types: training, evaluations, reports, and the same from Python."""

from __future__ import annotations

import os
import sys
from types import TracebackType

__all__ = ["say_interruptions"]


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
