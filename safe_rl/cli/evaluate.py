"""Evaluate a trained policy: ``safe-rl evaluate RUN_DIR [episodes=100 video=true]``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from safe_rl.checks import SettingError
from safe_rl.cli.options import run_command
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.runs.run import Run
from safe_rl.trust import check_imports, import_modules


def main(arguments: Sequence[str] | None = None, program: str = "safe-rl evaluate") -> int:
    """Run the command; return its exit status."""
    return run_command(carry_out, arguments, program, ["RUN_DIR"], EvaluationOptions)


def carry_out(words: list[str], options: EvaluationOptions, modules: list[str] | None) -> int:
    """Evaluate or certify a run, and print the results."""
    from safe_rl.evaluation import evaluate  # with torch: help does not need it
    from safe_rl.evaluation.policies import find_run

    directory = find_run(words[0])
    check_imports(Run(directory).config, modules, directory)
    import_modules(modules)
    if options.certify:
        return _certify(directory, options)
    if options.certificate:
        raise SettingError("certificate.…: it is the certificate's: add certify=true.")
    print(evaluate(directory, options, progress=True))
    return 0


def _certify(directory: Path, options: EvaluationOptions) -> int:
    """Certify a run; refuse options that would have no effect on its certificate."""
    from safe_rl.evaluation.certifying import certify_run

    names = ("certify", "certificate", "deterministic", "num_threads")
    read = {name: getattr(options, name) for name in names}
    for name, value in vars(EvaluationOptions(**read)).items():
        if getattr(options, name) != value:
            raise SettingError(
                f"{name}: it is ignored by certify=true. A certificate is about the run's own "
                "environment. Its options are certificate.episodes=… and so on, "
                "deterministic=true and num_threads=…"
            )
    certificate = certify_run(
        directory,
        num_threads=options.num_threads,
        changes=options.certificate,
        deterministic=options.deterministic,
    )
    print(certificate or "Nothing to certify: the run has no limits, or no checkpoints.")
    return 0 if certificate is not None and certificate.checkpoint is not None else 1
