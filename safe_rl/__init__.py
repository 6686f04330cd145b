"""Constrained reinforcement learning on TorchRL.

`safe_rl.train` and `safe_rl.load` are the way in from Python. `safe_rl.envs` holds the
environments, `safe_rl.objectives` the constrained losses and solvers, `safe_rl.algorithms` what
learns with them, `safe_rl.collectors` data collection with cost accounting.
"""

from typing import TYPE_CHECKING, Any

import safe_rl.openmp  # noqa: F401, whatever is imported first, this comes before torch

if TYPE_CHECKING:
    from safe_rl.cli.notebook import Run, load, train

__all__ = ["Run", "load", "train"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import what trains and loads when it is asked for: parts are used without it."""
    if name not in __all__:
        raise AttributeError(f"module 'safe_rl' has no attribute '{name}'")
    from safe_rl.cli import notebook

    return getattr(notebook, name)
