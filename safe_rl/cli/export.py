"""Write a trained policy for others: ``python -m safe_rl.export RUN_DIR policy.onnx``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from safe_rl.cli import say_interruptions
from safe_rl.cli.grammar import parse_options, usage
from safe_rl.evaluation.settings import option

__all__ = ["ExportOptions", "main"]

COMMAND = "python -m safe_rl.export"


@dataclass
class ExportOptions:
    """Options of ``python -m safe_rl.export``."""

    checkpoint: str = option(
        "", "last, best, certified, or a path; certified if there is one, else last"
    )


def main(arguments: Sequence[str] | None = None, program: str = COMMAND) -> int:
    """The command; returns its exit status."""
    say_interruptions()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if len(arguments) < 2 or arguments[0] in ("-h", "--help"):
        print(usage(f"{program} RUN_DIR FILE.onnx|FOLDER", ExportOptions))
        return 0 if arguments and arguments[0] in ("-h", "--help") else 2
    try:
        options = parse_options(arguments[2:], ExportOptions)
        print(f"wrote {_export(arguments[0], Path(arguments[1]), options.checkpoint)}")
    except (ValueError, OSError, ModuleNotFoundError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _export(source: str, target: Path, which: str) -> Path:
    # here, because help and mistyped options need none of torch
    from safe_rl.cli.trained_run import Run
    from safe_rl.evaluation.loading import find_checkpoint
    from safe_rl.evaluation.policies import export_onnx, find_run, pack_policy
    from safe_rl.runs.folder import RunFolder

    run = Run(find_run(source))
    has_certified = RunFolder(run.directory).newest_checkpoint("certified") is not None
    which = which or ("certified" if has_certified else "last")
    if target.suffix != ".onnx":
        return pack_policy(run.directory, target, which)
    with closing(run.make_env()) as env:
        export_onnx(run.config, env, find_checkpoint(run.directory, which), target)
    return target
