"""How idle threads of torch wait, and a description of the processor.

This module has to be imported before torch, because OpenMP reads the setting when torch is loaded.
By default, idle threads spin for milliseconds after every operation. So they take the cores from
the physics and from other programs: of two training runs on two cores, each is then ten times
slower than a single run. With the setting, idle threads sleep at once, which costs a few
microseconds per operation. A setting of the user is kept.

This is directly in ``safe_rl/``, because networks and updates both need the kind of processor.
"""

import os
import sys
import warnings
from functools import cache
from pathlib import Path

_FILE = Path("/proc/cpuinfo")

# GOMP_SPINCOUNT sets the same more finely
_SETTINGS = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")

if not any(setting in os.environ for setting in _SETTINGS):
    # processes that this one starts inherit it
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    if "torch" in sys.modules:
        warnings.warn(
            "torch was imported before safe_rl, so that its idle threads spin and slow down "
            "everything on these cores: import safe_rl first, or set OMP_WAIT_POLICY=PASSIVE.",
            stacklevel=3,
        )


@cache
def cpuinfo() -> str:
    """Return Linux's description of the processor; an empty text elsewhere."""
    return _FILE.read_text() if _FILE.is_file() else ""
