"""Write a trained policy for others: ``safe-rl export RUN_DIR policy.onnx``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from safe_rl.checks import CheckedOptions, SettingError, option
from safe_rl.cli.options import run_command
from safe_rl.files import print_line
from safe_rl.trust import check_imports, import_modules

if TYPE_CHECKING:
    from safe_rl.cli.python_api import Run


@dataclass
class ExportOptions(CheckedOptions):
    """Options of ``safe-rl export``."""

    checkpoint: str = option(
        "", "last, best, certified, or a path; certified if there is one, else last"
    )
    actions: Literal["mean", "sampled"] | None = option(
        None, "of FILE.onnx: mean or sampled; as they are certified, else mean"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command(export, arguments, "safe-rl export RUN_DIR FILE.onnx|FOLDER", ExportOptions)


def export(words: list[str], options: ExportOptions, modules: list[str] | None) -> int:
    """Write a policy to a file, or to a folder."""
    # imported here: help and errors about options do not need torch
    from safe_rl.cli.python_api import Run
    from safe_rl.evaluation.loading import transforms_of
    from safe_rl.evaluation.policies import export_onnx, find_run, pack_policy

    import_modules(modules)
    run, target = Run(find_run(words[0])), Path(words[1])
    has_certified = run.newest_checkpoint("certified") is not None
    which = options.checkpoint or ("certified" if has_certified else "last")
    if target.suffix not in ("", ".onnx"):
        raise SettingError(f"{target}: give a file FILE.onnx, or a FOLDER without a suffix.")
    if target.suffix == ".onnx":
        check_imports(run.config, modules, run.directory)
        checkpoint = run.find_checkpoint(which)
        sampled = _choose_actions(run, checkpoint, options.actions)
        target.parent.mkdir(parents=True, exist_ok=True)
        with closing(run.make_env()) as env:
            export_onnx(run, env, checkpoint, target, sampled=sampled)
        # the file's actions have the environment's own units already
        nodes = transforms_of(run.config).items()
        others = (
            n for n, node in nodes if not str(node.get("_target_")).endswith(".ActionScaling")
        )
        if names := ", ".join(others):
            print_line(
                f"The file has the policy without the transforms {names}: your program has to do "
                "what they do (see its metadata), and a certificate is about both together."
            )
    elif options.actions is not None:
        raise SettingError("actions: it is that of FILE.onnx. A FOLDER has the policy itself.")
    else:
        pack_policy(run.directory, target, which)
    print_line(f"wrote {target}")
    return 0


def _choose_actions(run: Run, checkpoint: Path, asked: str | None) -> bool:
    """Whether the exported policy samples: as it was certified, unless the user asks otherwise."""
    from safe_rl.evaluation.policies import is_sampled

    certificate = run.certificate_of(checkpoint)
    if certificate is None:
        return asked == "sampled"
    certified = "sampled" if is_sampled(certificate) else "mean"
    if asked not in (None, certified):
        print(
            f"WARNING: this policy is certified with {certified} actions. The file has its {asked} "
            "actions, which the certificate does not cover, and so the file has no certificate. To "
            "certify the policy with mean actions: safe-rl certify RUN_DIR "
            "deterministic=true",
            file=sys.stderr,
        )
    return (asked or certified) == "sampled"
