"""Carry out what ``python -m safe_rl.evaluate`` is asked for."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from safe_rl.cli.benchmark import suite
from safe_rl.cli.certificates import certify_run
from safe_rl.cli.grammar import CommandLineError
from safe_rl.cli.robots import maker_of
from safe_rl.cli.session import SETTING_ERRORS
from safe_rl.cli.user_code import check_imports, import_modules
from safe_rl.cli.variations import evaluate_varied, table_of
from safe_rl.envs import LayoutError, OpenGLError
from safe_rl.evaluation import Evaluation, EvaluationOptions, evaluate
from safe_rl.evaluation.loading import load_config
from safe_rl.evaluation.summary import format_estimates, format_unjudged

__all__ = ["carry_out", "evaluate_run"]

_ERRORS: tuple[type[Exception], ...] = (*SETTING_ERRORS, LayoutError, OpenGLError)


def evaluate_run(
    directory: Path, options: EvaluationOptions, *, progress: bool = False
) -> Evaluation:
    """:func:`safe_rl.evaluation.evaluate` with this package's environments and benchmark.

    Raises:
        ValueError: If the options ask for something else than an evaluation.
    """
    if options.certify or options.variations is not None:
        raise ValueError("evaluate: certificates are made by certify(), variations by vary(…).")
    return evaluate(
        directory, options, make_env=maker_of(directory), suite=suite(), progress=progress
    )


def carry_out(
    directory: Path, options: EvaluationOptions, modules: Sequence[str] | None = None
) -> int:
    """Evaluate, certify or vary a run, and print what was found.

    Args:
        directory: Folder of the run.
        options: What to do.
        modules: The user's modules to import; None if ``import=`` was not given.

    Returns:
        Exit status of the command.
    """
    try:
        check_imports(load_config(directory), modules, directory)
        import_modules(modules or ())
        if options.certify:
            _refuse_beside_certify(options)
            certificate = certify_run(
                directory, num_threads=options.num_threads, changes=options.certificate
            )
            print(certificate or "Nothing to certify: the run has no limits, or no checkpoints.")
            return 0 if certificate is not None and certificate.checkpoint is not None else 1
        if options.variations is not None:
            found, picture = evaluate_varied(directory, options, progress=True)
            print(table_of(found), f"wrote {found.file}", f"wrote {picture}", sep="\n")
            return 0
        result = evaluate_run(directory, options, progress=True)
    except _ERRORS as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(_report(result))
    return 0


def _refuse_beside_certify(options: EvaluationOptions) -> None:
    """A certificate is of the run's own problem: what else is asked for would have no effect."""
    heeded = ("certify", "certificate", "num_threads")
    plain = EvaluationOptions()
    for field in fields(options):
        if field.name not in heeded and getattr(options, field.name) != getattr(plain, field.name):
            raise CommandLineError(
                f"{field.name}: certify=true does not heed it. A certificate is of the run's own "
                "environment, and takes certificate.episodes=… and the like, and num_threads=…"
            )


def _report(result: Evaluation) -> str:
    facts = result.facts
    steps = "" if facts["steps"] is None else f" at {facts['steps']:,} steps"
    manner = "its mean actions" if facts["deterministic"] else "sampled actions"
    lines = [
        f"{facts['algorithm']} on {facts['environment']}{steps}: {facts['episodes']} episodes with "
        f"{manner}, {facts['layouts_trained_on']:.0%} of the layouts known from training",
        *format_estimates(result.estimates, facts["cost_limits"]),
        *format_unjudged(facts["limits_without_cost"]),
        *(f"wrote {path}" for path in result.files),
    ]
    return "\n".join(lines)
