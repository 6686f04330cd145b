"""Evaluate a trained policy: ``python -m safe_rl.evaluate RUN_DIR [episodes=100 video=true]``."""

from __future__ import annotations

from collections.abc import Sequence

from safe_rl.cli.grammar import run_command
from safe_rl.evaluation.settings import EvaluationOptions

__all__ = ["main"]


def main(
    arguments: Sequence[str] | None = None, program: str = "python -m safe_rl.evaluate"
) -> int:
    """The command; returns its exit status."""
    return run_command(_carry_out, arguments, f"{program} RUN_DIR", EvaluationOptions)


def _carry_out(first: list[str], options: EvaluationOptions, modules: list[str] | None) -> int:
    # here, because help and mistyped options need none of torch
    from safe_rl.cli.evaluating import carry_out

    return carry_out(first[0], options, modules)
