"""Constrained reinforcement learning on TorchRL.

`safe_rl.train`, `resume`, `load`, `evaluate`, `report` and `make_env` are the functions to begin
with. `safe_rl.envs` has the environments, `safe_rl.objectives` the constrained losses and solvers,
`safe_rl.algorithms` the algorithms that use them, and `safe_rl.collectors` data collection with
cost accounting.
"""

from typing import TYPE_CHECKING

import safe_rl.processor  # noqa: F401, must precede torch
from safe_rl.extras import import_later

if TYPE_CHECKING:
    from safe_rl.cli.python_api import Run, evaluate, load, report, resume, train
    from safe_rl.envs import make_env

__all__ = ["Run", "evaluate", "load", "make_env", "report", "resume", "train"]
__version__ = "0.1.0"

__getattr__, __dir__ = import_later(
    __name__,
    {
        "cli.python_api": ["Run", "evaluate", "load", "report", "resume", "train"],
        "envs": ["make_env"],
    },
)
