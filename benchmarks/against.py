"""Run one of the scripts beside the same script of an older commit, in turns.

The older commit is checked out into a temporary worktree. Every number of the printed tables is
compared: the medians over the turns, and the median of the ratios of each turn.

    python benchmarks/against.py 01ae8c28 train_throughput.py env=PointGoal1 algo=ppo_lagrangian
    python benchmarks/against.py HEAD~1 env_throughput.py --envs PointGoal1 --num-envs 100
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[1]


def tables(text):
    """(name of the row, name of the column) -> number, of all Markdown tables in a text."""
    found, header = {}, None
    for line in text.splitlines():
        if not line.startswith("|"):
            header = None
        elif header is None:
            header = [cell.strip() for cell in line.strip("|").split("|")]
        elif not re.fullmatch(r"[|\s:-]+", line):
            name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
            for column, cell in zip(header[1:], cells, strict=True):
                if re.fullmatch(r"[\d,]*\.?\d+", cell):
                    found[name, column] = float(cell.replace(",", ""))
    return found


def measure(tree, script, arguments):
    """The numbers that the script of a tree prints."""
    command = [sys.executable, str(tree / "benchmarks" / script), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    printed = subprocess.run(
        command, cwd=tree, env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    return tables(printed.stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commit", help="the older commit")
    parser.add_argument("script", help="name of a script of this folder, then its arguments")
    parser.add_argument("--turns", type=int, default=3)
    options, arguments = parser.parse_known_args()
    git = ["git", "-C", str(ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        older = Path(folder, "older")
        subprocess.run([*git, "add", "-q", "--detach", older, options.commit], check=True)
        try:
            turns = [
                [measure(tree, options.script, arguments) for tree in (ROOT, older)]
                for _ in range(options.turns)
            ]
        finally:
            subprocess.run([*git, "remove", "--force", older], check=True)
    if not turns[0][1]:
        sys.exit(f"{options.script} of {options.commit} prints no table with numbers.")
    print(f"| row | column | here | {options.commit} | here / {options.commit} |")
    print("|---|---|---|---|---|")
    for row, column in turns[0][0]:
        pairs = [(now.get((row, column)), then.get((row, column))) for now, then in turns]
        if all(all(pair) for pair in pairs):
            now, then = (median(side) for side in zip(*pairs, strict=True))
            ratio = median(here / there for here, there in pairs)
            print(f"| {row} | {column} | {now:,g} | {then:,g} | {ratio:.3f} |")


if __name__ == "__main__":
    main()
