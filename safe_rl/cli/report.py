"""Report a folder of runs: ``safe-rl report RUNS_DIR [seeds=3 title=...]``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from safe_rl.cli.options import run_command
from safe_rl.envs import SUITE, env_node, resolve
from safe_rl.files import check_place, print_line, printable
from safe_rl.reporting import Report, ReportOptions, build_report, write_report
from safe_rl.reporting.archive import archive_runs
from safe_rl.reporting.tables import clean
from safe_rl.scores.benchmark import Suite
from safe_rl.trust import import_modules


def suite() -> Suite:
    """All environments of the suite, every key of each."""
    nodes = {name: env_node(name) for name in SUITE}
    return Suite(nodes, env_node(resolve({})))


def report(root: Path, options: ReportOptions) -> tuple[Report, Path]:
    """Report the runs below a folder; return the content of the report, and its page.

    Raises:
        FileNotFoundError: If there is no run.
        OSError: If the page cannot be written; this is checked before any run is read.
        ValueError: If RUNS_DIR/report is a link, because another person could have chosen what it
            overwrites.
    """
    out = root / "report" if options.out is None else Path(options.out).expanduser()
    if options.out is None and out.is_symlink():
        raise ValueError(f"{out} is a link: remove it, or give out=FOLDER.")
    if root.is_dir():
        check_place(out / "report.html", "out=FOLDER writes the report elsewhere.")
    result = build_report(root, suite(), options)
    page = write_report(result, out, options.title or root.resolve().name, options)
    if options.archive is not None:
        archive_runs(result.runs, root, Path(options.archive).expanduser())
    return result, page


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status."""
    return run_command(carry_out, arguments, "safe-rl report RUNS_DIR", ReportOptions)


def carry_out(words: list[str], options: ReportOptions, modules: list[str] | None) -> int:
    """Report the runs below a folder, the first word, and print what was left out."""
    import_modules(modules)
    root = Path(words[0])
    result, page = report(root, options)
    if options.archive is not None:
        print_line(f"kept {len(result.runs)} runs in {options.archive}")
    for path, reason in result.skipped.items():
        print(f"left out {clean(path)}: {printable(reason)}", file=sys.stderr)
    print_line(f"wrote {page}")
    return 0
