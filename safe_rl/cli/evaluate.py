"""Evaluate a trained policy: ``python -m safe_rl.evaluate RUN_DIR [episodes=100 video=true]``."""

from __future__ import annotations

from collections.abc import Sequence

from safe_rl.cli.grammar import run_command
from safe_rl.evaluation.settings import EvaluationOptions

__all__ = ["main"]


def main(
    arguments: Sequence[str] | None = None, program: str = "python -m safe_rl.evaluate"
) -> int:
    """Run the command; return its exit status."""
    work = "safe_rl.cli.evaluating:carry_out"
    return run_command(work, arguments, f"{program} RUN_DIR", EvaluationOptions)
