"""Two independent updates at the same time: how a second core is put to use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

__all__ = ["in_parallel", "torch_threads"]


@contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Let torch compute with `number` threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def in_parallel(first: Callable[[], Any], second: Callable[[], Any]) -> tuple[Any, Any]:
    """Call two functions that share nothing they change, each with half of torch's threads.

    Minibatches of narrow networks are too small to be worth two threads each: two of them side by
    side are. With one thread, the second function follows the first. TorchRL's exploration type is
    DETERMINISTIC meanwhile, as in its losses.

    Args:
        first: Called in this thread.
        second: Called in a thread of its own.

    Returns:
        What they return. Both have ended, also if one of them raises.

    Examples:
        >>> in_parallel(lambda: 1, lambda: 2)
        (1, 2)
    """
    threads = torch.get_num_threads()
    # Losses set the process's one exploration type, and put back what they have found: in two
    # threads that is the other's. So it is the same before, and only this block restores it.
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return (first(), second()) if threads == 1 else _beside(first, second, threads // 2)


def _beside(first: Callable[[], Any], second: Callable[[], Any], threads: int) -> tuple[Any, Any]:
    def beside() -> Any:
        torch.set_num_threads(threads)  # a setting of each thread's own
        return second()

    with torch_threads(threads), ThreadPoolExecutor(max_workers=1) as pool:
        other = pool.submit(beside)
        return first(), other.result()
