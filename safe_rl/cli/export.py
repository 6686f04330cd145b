"""Write a trained policy for others: ``python -m safe_rl.export RUN_DIR policy.onnx``."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from safe_rl.cli.grammar import CommandLineError, run_command
from safe_rl.cli.user_code import check_imports, import_modules
from safe_rl.evaluation.settings import option


@dataclass
class ExportOptions:
    """Options of ``python -m safe_rl.export``."""

    checkpoint: str = option(
        "", "last, best, certified, or a path; certified if there is one, else last"
    )


def main(arguments: Sequence[str] | None = None, program: str = "python -m safe_rl.export") -> int:
    """Run the command; return its exit status."""
    places = f"{program} RUN_DIR FILE.onnx|FOLDER"
    return run_command(export, arguments, places, ExportOptions)


def export(words: list[str], options: ExportOptions, modules: list[str] | None) -> int:
    """Write a policy to a file, or to a folder."""
    # imported here: help and errors about options do not need torch
    from safe_rl.cli.python_api import Run
    from safe_rl.evaluation.loading import find_checkpoint
    from safe_rl.evaluation.policies import export_onnx, find_run, pack_policy
    from safe_rl.runs.folder import RunFolder

    import_modules(modules)
    run, target = Run(find_run(words[0])), Path(words[1])
    has_certified = RunFolder(run.directory).newest_checkpoint("certified") is not None
    which = options.checkpoint or ("certified" if has_certified else "last")
    if target.suffix not in ("", ".onnx"):
        raise CommandLineError(f"{target}: give a file FILE.onnx, or a FOLDER without a suffix.")
    if target.suffix == ".onnx":
        check_imports(run.config, modules, run.directory)
        with closing(run.make_env()) as env:
            export_onnx(run.config, env, find_checkpoint(run.directory, which), target)
    else:
        target = pack_policy(run.directory, target, which)
    print(f"wrote {target}")
    return 0
