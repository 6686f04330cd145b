"""What the processor is: which of torch's ways to compute the same thing is quick on it.

It stands on the top floor because networks and updates both ask, and know nothing of each other.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

__all__ = ["cpuinfo"]

_FILE = Path("/proc/cpuinfo")


@cache
def cpuinfo() -> str:
    """Return what Linux says of the processor; nothing elsewhere."""
    return _FILE.read_text() if _FILE.is_file() else ""
