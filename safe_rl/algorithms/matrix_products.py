"""Matrix products by the kernels that suit the processor."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch

from safe_rl.processor import cpuinfo

__all__ = ["fast_products", "prefers_onednn"]


def prefers_onednn(cpuinfo: str) -> bool:
    """Whether oneDNN multiplies matrices faster than MKL on a processor, and as exactly.

    MKL leaves half of the width of AMD's vector units unused: oneDNN takes about half as long there
    for products of minibatches. torch asks it only if products may be rounded to bfloat16,
    of which oneDNN makes use where there are tile registers (AMX), and nowhere else.

    Args:
        cpuinfo: What Linux says of the processor, the text of ``/proc/cpuinfo``.

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
    """Let torch multiply matrices inside the block by oneDNN, on processors that it suits.

    For updates, whose minibatches have thousands of rows: a call costs some ten microseconds
    more, too many for the few rows that a policy acts on. Sums differ in their last digits.
    What the caller has set (``torch.backends.mkldnn.matmul.fp32_precision``) is kept.

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
