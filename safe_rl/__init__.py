"""Constrained reinforcement learning on TorchRL.

`safe_rl.train`, `resume`, `load`, `evaluate`, `report` and `make_env` are the functions to begin
with. `safe_rl.envs` has the environments, `safe_rl.objectives` the constrained losses and solvers,
`safe_rl.algorithms` the algorithms that use them, and `safe_rl.collectors` data collection with
cost accounting.
"""

import os
import sys
import warnings
from typing import TYPE_CHECKING

from safe_rl.extras import import_later

if TYPE_CHECKING:
    from safe_rl.cli.python_api import Run, evaluate, load, report, resume, train
    from safe_rl.envs import make_env

# By default idle threads of OpenMP spin for milliseconds after every operation of torch, and take
# the cores from physics and other programs: of two runs on two cores, each is then ten times
# slower than one alone. OpenMP reads this when torch is loaded; processes of this one inherit it.
# GOMP_SPINCOUNT sets the same more finely.
if not {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"} & os.environ.keys():
    os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
    if "torch" in sys.modules:
        warnings.warn(
            "torch was imported before safe_rl, so that its idle threads spin and slow down "
            "everything on these cores: import safe_rl first, or set OMP_WAIT_POLICY=PASSIVE.",
            stacklevel=2,
        )

__all__ = ["Run", "evaluate", "load", "make_env", "report", "resume", "train"]
__version__ = "0.1.0"

__getattr__, __dir__ = import_later(
    __name__,
    {
        "cli.python_api": ["Run", "evaluate", "load", "report", "resume", "train"],
        "envs": ["make_env"],
    },
)
