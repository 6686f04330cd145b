"""Evaluate or certify a trained policy, or run it under variations."""

from __future__ import annotations

from pathlib import Path

from safe_rl.cli.report import suite
from safe_rl.evaluation import (
    Evaluation,
    EvaluationOptions,
    evaluate,
)
from safe_rl.evaluation.loading import maker_of
from safe_rl.evaluation.policies import writable_copy
from safe_rl.evaluation.variations import Varied, evaluate_variations
from safe_rl.reporting.figures import draw_variations
from safe_rl.runs.run import Run


def evaluate_run(
    directory: Path, options: EvaluationOptions, *, progress: bool = False
) -> Evaluation:
    """:func:`safe_rl.evaluation.evaluate` with this package's environments and benchmark.

    Raises:
        ValueError: If the options ask for a certificate or for variations.
    """
    directory = writable_copy(directory)
    if options.certify or options.variations is not None:
        raise ValueError("evaluate: certificates are made by certify(), variations by vary(…).")
    make = maker_of(directory)
    return evaluate(directory, options, make_env=make, suite=suite(), progress=progress)


def evaluate_varied(
    directory: Path, options: EvaluationOptions, *, progress: bool = False
) -> tuple[Varied, Path]:
    """Run a policy under ``options.variations``, and write a table and a picture.

    Returns:
        The results, and the path of the picture.
    """
    directory = writable_copy(directory)
    make = maker_of(directory)
    found = evaluate_variations(directory, options, make_env=make, progress=progress)
    picture = Run(directory).variations_file(options.name, "png")
    draw_variations(found.rows, found.cost_limits, picture)
    return found, picture
