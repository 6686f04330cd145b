"""Learning curves from results/: of an algorithm for its page, of five environments for README.

Pages get theirs when the site is built. ``python docs/_site/curves.py`` draws those of README,
docs/holding_the_limit.png, again.
"""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from PIL import Image

from safe_rl.cli.report import suite
from safe_rl.reporting.archive import find_runs
from safe_rl.reporting.curves import draw_experiment, draw_learning_curves, limits_of, set_axes
from safe_rl.reporting.experiments import Experiment, group_runs
from safe_rl.reporting.figures import LIMIT_STYLE, add_legend, algorithm_styles
from safe_rl.runs.curves import save_figure

ROOT = Path(__file__).resolve().parents[2]


@cache
def pictures() -> dict[str, bytes]:
    """Algorithm -> its learning curves, every environment a row, with 95 % intervals over seeds.

    Seeds of other settings have curves of their own.
    """
    experiments = archived("algorithms")
    styles = algorithm_styles(experiments)
    made = {}
    with tempfile.TemporaryDirectory() as folder:
        for algo in dict.fromkeys(e.runs[0].algorithm for e in experiments):
            shown = [e for e in experiments if e.runs[0].algorithm == algo]
            figure = draw_learning_curves(shown, styles)
            made[algo] = save_figure(figure, Path(folder) / f"{algo}.png").read_bytes()
    return made


def curves(algo: str) -> str:
    """The picture of an algorithm; nothing for one that has not run."""
    said = f"Return, episode cost and cost rate of {algo} on PointGoal1 and CarGoal1"
    return f"![{said}]({algo}.png)" if algo in pictures() else ""


def draw_readme() -> None:
    """Draw what README shows."""
    held = archived("held_out")
    picture = save_figure(draw_columns(held), ROOT / "docs" / "holding_the_limit.png")
    # a third of the bytes: so many bands over one another have no more colours than fit a palette
    Image.open(picture).convert("RGB").quantize(256).save(picture, optimize=True)


def archived(campaign: str) -> list[Experiment]:
    """Experiments of a campaign in results/."""
    return group_runs(find_runs(ROOT / "results" / campaign)[0], suite())[0]


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
    draw_readme()
