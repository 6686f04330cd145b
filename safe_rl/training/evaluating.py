"""What the loop asks of an evaluation in between; the loop itself knows none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from tensordict.nn import TensorDictModuleBase

__all__ = ["Evaluation", "MakeEvaluation"]


class Evaluation(Protocol):
    """What evaluates a policy while it is trained."""

    def __call__(self, before: int, after: int) -> dict[str, float]:
        """Columns after an epoch, between two numbers of steps: the same at every call."""
        ...


MakeEvaluation = Callable[[TensorDictModuleBase], Evaluation]
"""Makes an evaluation of a policy that goes on learning."""
