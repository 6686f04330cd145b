"""How updates use the processor: kernels of matrix products, and two updates at the same time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from safe_rl.processor import cpuinfo


def prefers_onednn(cpuinfo: str) -> bool:
    """Whether oneDNN multiplies matrices faster than MKL on a processor, and as exactly.

    MKL does not use half of the width of AMD's vector units. There oneDNN takes about half as long
    for products of minibatches. torch uses oneDNN only if products may be rounded to bfloat16.
    oneDNN really rounds only on processors with tile registers (AMX).

    Examples:
        >>> prefers_onednn("vendor_id : AuthenticAMD flags : fpu avx2 avx512f")
        True
        >>> prefers_onednn("vendor_id : GenuineIntel flags : fpu avx2 avx512f amx_tile")
        False
    """
    words = set(cpuinfo.split())
    has_tiles = any(word.startswith("amx") for word in words)
    return {"AuthenticAMD", "avx512f"} <= words and not has_tiles


@cache
def _is_of_use() -> bool:
    return torch.backends.mkldnn.is_available() and prefers_onednn(cpuinfo())


@contextmanager
def fast_products() -> Iterator[None]:
    """Let torch multiply matrices by oneDNN inside the block, on processors where it is faster.

    Use it for updates, whose minibatches have thousands of rows. A call takes some ten microseconds
    more, which is too much for the few rows that a policy acts on. Sums differ in their last
    digits. A setting of the caller (``torch.backends.mkldnn.matmul.fp32_precision``) is kept.

    Examples:
        >>> with fast_products():
        ...     product = torch.ones(300, 64) @ torch.ones(64, 64)
        >>> product[0, 0].item()
        64.0
    """
    products = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]  # made at run time
    before = products.fp32_precision
    if before != "none" or not _is_of_use():
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
    """Call two functions that share nothing they change, each with half of torch's threads.

    With narrow networks, the computations of one minibatch are too small for two threads, so it is
    faster to run two updates at the same time. With one thread, the second function follows the
    first. TorchRL's exploration type is DETERMINISTIC meanwhile, as in its losses. Both functions
    have ended on return, even if one of them raises an error.
    """
    threads = torch.get_num_threads()
    # Losses set the exploration type, of which a process has only one, and then restore it. In two
    # threads, one would restore what the other has set. So it is set before both and restored here.
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        if threads == 1:
            return first(), second()
        half = threads // 2
        # the number of threads is a setting of each thread's own
        pool = ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(half,))
        with torch_threads(half), pool:
            other = pool.submit(second)
            return first(), other.result()
