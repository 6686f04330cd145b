"""The kind of processor, for choices between equivalent computations of torch.

In `safe_rl` itself, because networks and updates both use it.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

__all__ = ["cpuinfo"]

_FILE = Path("/proc/cpuinfo")


@cache
def cpuinfo() -> str:
    """Return Linux's description of the processor; an empty text elsewhere."""
    return _FILE.read_text() if _FILE.is_file() else ""
