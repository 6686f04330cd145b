"""Stopping a run at the end of an epoch, so that its last checkpoint is a whole one."""

from __future__ import annotations

import signal
import threading
from types import FrameType

__all__ = ["StopRequest"]


class StopRequest:
    """Remembers the first SIGINT (Ctrl-C), SIGTERM or SIGHUP; the second acts as it always did.

    SIGHUP, which comes when a terminal is closed, stays ignored where it is, as below ``nohup``.
    Signals can only be caught in the main thread; elsewhere this does nothing.

    Examples:
        >>> import signal
        >>> with StopRequest() as stop:
        ...     signal.raise_signal(signal.SIGTERM)
        ...     stop.received is signal.SIGTERM
        True
    """

    _SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM, signal.SIGHUP})

    def __init__(self) -> None:
        self.received: signal.Signals | None = None
        self._previous: dict[int, signal._HANDLER] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            # what a shell runs in the background ignores SIGINT, too, but is to heed it when asked
            is_kept_up = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            heeded = self._SIGNALS - {signal.SIGHUP} if is_kept_up else self._SIGNALS
            self._previous = {number: signal.signal(number, self._stop) for number in heeded}
        return self

    def __exit__(self, *exception: object) -> None:
        self._restore()

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.received = signal.Signals(number)
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous = {}
