"""Learning curves for the pages of the algorithms, from results/algorithms/.

``python docs/draw_algorithms.py`` draws docs/algorithms/<name>.png: every environment a row, with
mean and 95 % interval over seeds; seeds of other settings have curves of their own.
"""

from __future__ import annotations

from pathlib import Path

from safe_rl.cli.benchmark import suite
from safe_rl.reporting.experiments import group_runs
from safe_rl.reporting.pictures import algorithm_styles, draw_learning_curves, save
from safe_rl.reporting.recorded import find_runs

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Draw all of them."""
    results = ROOT / "results" / "algorithms"
    runs, _ = find_runs(results)
    experiments, _ = group_runs(runs, suite(), {}, results)
    styles = algorithm_styles(experiments)
    for algorithm in dict.fromkeys(run.algorithm for run in runs):
        shown = [e for e in experiments if e.runs[0].algorithm == algorithm]
        figure = draw_learning_curves(shown, styles)
        save(figure, ROOT / "docs" / "algorithms" / f"{algorithm}.png")


if __name__ == "__main__":
    main()
