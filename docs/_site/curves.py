"""``python docs/_site/curves.py`` draws docs/holding_the_limit.png again, from results/."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from PIL import Image

from safe_rl.cli.report import suite
from safe_rl.reporting.archive import find_runs
from safe_rl.reporting.curves import draw_experiment, limits_of, set_axes
from safe_rl.reporting.experiments import Experiment, group_runs
from safe_rl.reporting.figures import LIMIT_STYLE, add_legend, algorithm_styles
from safe_rl.runs.curves import save_figure

ROOT = Path(__file__).resolve().parents[2]


def draw() -> None:
    """Draw the picture."""
    held = group_runs(find_runs(ROOT / "results" / "held_out")[0], suite())[0]
    picture = save_figure(draw_columns(held), ROOT / "docs" / "holding_the_limit.png")
    # a third of the bytes: so many bands over one another have no more colours than fit a palette
    Image.open(picture).convert("RGB").quantize(256).save(picture, optimize=True)


def draw_columns(experiments: list[Experiment]) -> Figure:
    """Return, episode cost and cost rate below one another, an environment beside the other.

    Where costs begin, at ten times the limit, is cut off: it is by the limit that they are judged.
    """
    names = list(dict.fromkeys(e.environment for e in experiments))
    figure = Figure(figsize=(12.0, 6.2), layout="constrained")
    panels = figure.subplots(3, len(names), sharex=True)
    styles = algorithm_styles(experiments)
    for axes, name in zip(panels.T, names, strict=True):
        shown = [e for e in experiments if e.environment == name]
        for experiment in shown:
            draw_experiment(experiment, "cost", axes, styles[experiment.label])
        set_axes(axes)
        for panel, height in limits_of(shown, "cost"):
            axes[panel].axhline(height, **LIMIT_STYLE)
            axes[panel].set_ylim(0, 4 * height)
        axes[0].set_title(name, fontweight="bold")
        axes[2].set_xlabel("environment steps")
        axes[2].xaxis.set_major_locator(MultipleLocator(1_000_000))
    for axis, title in zip(panels[:, 0], ("Return", "Episode cost", "Cost rate"), strict=True):
        axis.set_ylabel(title, fontweight="bold")
    add_legend(figure, panels[0])
    return figure


if __name__ == "__main__":
    draw()
