"""A plain single-world reference implementation of Safety Gym, the yardstick of the batched one.

One `mujoco.MjData`, Python loops over objects and contacts, nothing shared with `safe_rl`:
where the two disagree, one of them has misread `environments.md`. Not for training: it compiles
a model for every layout.
"""

from .layout import by_kind
from .reference import ReferenceWorld

__all__ = ["ReferenceWorld", "by_kind"]
