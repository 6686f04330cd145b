"""How updates use the processor: kernels of matrix products, and two updates at the same time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from safe_rl.models.networks import cpuinfo


@cache
def prefers_onednn(cpuinfo: str) -> bool:
    """Whether oneDNN multiplies matrices faster than MKL on a processor, and as exactly.

    MKL does not use half of the width of AMD's vector units. There oneDNN takes about half as long
    for products of minibatches. torch uses oneDNN only if products may be rounded to bfloat16.
    oneDNN really rounds only on processors with tile registers (AMX).
    """
    words = set(cpuinfo.split())
    has_tiles = any(word.startswith("amx") for word in words)
    return {"AuthenticAMD", "avx512f"} <= words and not has_tiles


@contextmanager
def fast_products() -> Iterator[None]:
    """Let torch multiply matrices by oneDNN inside the block, on processors where it is faster.

    Use it for updates, whose minibatches have thousands of rows. Each product takes about ten
    microseconds longer to start, which is too much for the few rows of a policy that acts. Sums
    differ in their last digits. If ``torch.backends.mkldnn.matmul.fp32_precision`` has been set,
    this setting is kept.
    """
    products = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]  # made at run time
    before = products.fp32_precision
    is_available = torch.backends.mkldnn.is_available()
    if before != "none" or not (is_available and prefers_onednn(cpuinfo())):
        yield
        return
    products.fp32_precision = "bf16"
    try:
        yield
    finally:
        products.fp32_precision = before


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
    """Call two functions at the same time, each with half of torch's threads.

    Neither function may change data that the other one uses. With narrow networks, one minibatch is
    too little work for two threads, so two updates at the same time are faster. If torch has only
    one thread, the functions are called one after the other. During the calls TorchRL's exploration
    type is DETERMINISTIC, as in its losses. Both functions have ended when this one returns or
    raises an error.
    """
    threads = torch.get_num_threads()
    # Losses set the exploration type and then restore the previous one. It is global, so of two
    # threads one could restore the type that the other has set. Here it is set once for both.
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        if threads == 1:
            return first(), second()
        half = threads // 2
        # the number of threads is a setting of each thread's own
        pool = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(half,))
        with torch_threads(half), pool:
            other = pool.submit(second)
            return first(), other.result()
