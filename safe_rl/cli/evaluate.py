"""Evaluate a trained policy: ``python -m safe_rl.evaluate RUN_DIR [episodes=100 video=true]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from safe_rl.cli import say_interruptions
from safe_rl.cli.grammar import CommandLineError, parse_options, usage
from safe_rl.cli.user_code import split_imports
from safe_rl.evaluation.settings import EvaluationOptions

__all__ = ["main"]

COMMAND = "python -m safe_rl.evaluate"


def main(arguments: Sequence[str] | None = None, program: str = COMMAND) -> int:
    """The command; returns its exit status."""
    say_interruptions()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage(f"{program} RUN_DIR", EvaluationOptions))
        return 0 if arguments else 2
    try:
        modules, arguments = split_imports(arguments)
        if not arguments:
            raise CommandLineError(f"{program} takes the folder of a run first.")
        directory, options = Path(arguments[0]), parse_options(arguments[1:], EvaluationOptions)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    # here, because help and mistyped options need none of torch
    from safe_rl.cli.evaluating import carry_out

    return carry_out(directory, options, modules)
