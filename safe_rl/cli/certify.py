"""Certify a trained policy: ``safe-rl certify RUN_DIR [certificate.episodes=3000 …]``."""

from __future__ import annotations

from collections.abc import Sequence

from safe_rl.cli.options import run_command
from safe_rl.evaluation.settings import CertifyOptions
from safe_rl.files import print_line
from safe_rl.runs.run import Run
from safe_rl.trust import check_imports, import_modules


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command(carry_out, arguments, "safe-rl certify RUN_DIR", CertifyOptions)


def carry_out(words: list[str], options: CertifyOptions, modules: list[str] | None) -> int:
    """Test which checkpoint of a run keeps its limits, and print the certificate."""
    from safe_rl.evaluation.certifying import certify_run  # with torch: help does not need it
    from safe_rl.evaluation.policies import find_run

    directory = find_run(words[0])
    check_imports(Run(directory).config, modules, directory)
    import_modules(modules)
    certificate = certify_run(
        directory,
        num_threads=options.num_threads,
        changes=options.certificate,
        deterministic=options.deterministic,
    )
    print_line(certificate or "Nothing to certify: the run has no limits, or no checkpoints.")
    return 0 if certificate is not None and certificate.checkpoint is not None else 1
