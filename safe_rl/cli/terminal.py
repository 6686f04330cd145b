"""What a command does about its terminal: closed streams, narrow encodings, Ctrl-C."""

import os
import signal
import sys
import warnings
from typing import NoReturn

from safe_rl.files import printable

_FORMAT = warnings.formatwarning


def keep_streams() -> None:
    """Let the command print, whatever its streams are.

    A stream that is closed takes what is written, and characters that the encoding lacks, such as ≤
    in ASCII, are escaped: neither may end a run or change the exit status. Warnings, which may
    quote files of others, are shown without control characters.
    """
    warnings.formatwarning = lambda *parts, **names: printable(_FORMAT(*parts, **names))
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def end_by_interrupt() -> NoReturn:
    """Say that Ctrl-C was pressed, and end by its signal: a shell's loop over commands ends too."""
    print("Interrupted.", file=sys.stderr)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGINT)
    raise KeyboardInterrupt
