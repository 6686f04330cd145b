"""Evaluate a trained policy: ``safe-rl evaluate RUN_DIR [episodes=100 video=true]``."""

from __future__ import annotations

from collections.abc import Sequence

from safe_rl.cli.options import run_command
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.files import print_line
from safe_rl.runs.run import Run
from safe_rl.trust import check_imports, import_modules


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command(carry_out, arguments, "safe-rl evaluate RUN_DIR", EvaluationOptions)


def carry_out(words: list[str], options: EvaluationOptions, modules: list[str] | None) -> int:
    """Evaluate a run, and print the results."""
    from safe_rl.evaluation import evaluate  # with torch: help does not need it
    from safe_rl.evaluation.policies import find_run

    directory = find_run(words[0])
    check_imports(Run(directory).config, modules, directory)
    import_modules(modules)
    print_line(evaluate(directory, options, progress=True))
    return 0
