"""How torch's idle threads wait: set before torch is loaded, because OpenMP reads it then.

By default they spin for milliseconds after every operation and take the cores from the physics
and other programs: two training runs on two cores then go ten times slower than one, not
twice. Sleeping at once costs a few microseconds per operation. A setting of the user's is kept.
"""

import os
import sys
import warnings

# GOMP_SPINCOUNT is a finer setting of the same
_SETTINGS = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")

if not any(setting in os.environ for setting in _SETTINGS):
    # also for processes that this one starts
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    if "torch" in sys.modules:
        warnings.warn(
            "torch was imported before safe_rl, so that its idle threads spin and slow down "
            "everything on these cores: import safe_rl first, or set OMP_WAIT_POLICY=PASSIVE.",
            stacklevel=3,
        )
