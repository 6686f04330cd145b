"""The end of collectors' processes that would not end by themselves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from multiprocessing.queues import Queue
from typing import Any

__all__ = ["end_processes"]


def end_processes(collector: Any) -> None:
    """Kill the processes of a collector, and let go of all that this one would wait for.

    Args:
        collector: TorchRL's; None if it has failed before it came to have any.
    """
    if collector is None:
        return
    processes = [p for p in getattr(collector, "procs", []) if not p._closed]
    for process in processes:
        process.kill()
    for process in processes:
        process.join(timeout=5.0)
    # weights on their way to a process that is no more: Python would wait for them at exit, and for
    # a thread that the schemes begin when they are deleted then
    schemes = (getattr(collector, "_weight_sync_schemes", None) or {}).values()
    for holder in (collector, *schemes):
        for queue in _queues(vars(holder).values()):
            queue.cancel_join_thread()
    for scheme in schemes:
        scheme.shutdown()
    collector.closed = True


def _queues(values: Iterable[Any]) -> Iterator[Queue]:
    for value in values:
        if isinstance(value, Queue):
            yield value
        elif isinstance(value, dict):
            yield from _queues(value.values())
