"""``python docs/_site/curves.py`` draws docs/figure_7.png, 8 and 9 again, from results/."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from safe_rl.cli.report import suite
from safe_rl.reporting.archive import read_runs
from safe_rl.reporting.curves import benchmark_figures
from safe_rl.reporting.experiments import group_runs
from safe_rl.reporting.figures import WIDTH
from safe_rl.runs.curves import save_figure

ROOT = Path(__file__).resolve().parents[2]


def draw() -> None:
    """Draw the pictures, as ``safe-rl report results`` does."""
    for drawing in benchmark_figures(group_runs(read_runs(ROOT / "results")[0], suite())[0], WIDTH):
        picture = save_figure(drawing.figure, ROOT / "docs" / f"{drawing.name}.png")
        # a third of the bytes: bands over one another have no more colours than fit a palette
        Image.open(picture).convert("RGB").quantize(256).save(picture, optimize=True)


if __name__ == "__main__":
    draw()
