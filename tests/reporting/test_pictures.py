"""What the report draws: curves with their bands and limits, styles, legends, fronts."""

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from synthetic import experiments_in, write_run

from safe_rl.reporting.curves import benchmark_figures, curves_of_experiments
from safe_rl.reporting.experiments import PACKAGED
from safe_rl.reporting.figures import add_legend, algorithm_styles, fronts
from safe_rl.reporting.scoring import final_table
from safe_rl.runs.curves import save_figure

ROWS = {"returns": (1.0, 2.0, 3.0)}


def learning_pictures(experiments):
    drawings = curves_of_experiments(experiments, algorithm_styles(experiments), 12.0)
    return [drawing.figure for drawing in drawings]


def test_panels_have_means_intervals_and_limits(tmp_path):
    for seed, cost in ((0, 30.0), (10, 36.0)):
        write_run(tmp_path, "PointGoal1", "ppo", seed, **ROWS, costs=cost)
    shorter = {"env_changes": {"num_steps": 500}, "limits": {"cost": 10.0}}
    write_run(tmp_path, "PointGoal2", "cpo", **ROWS, **shorter, frames=10**6)
    write_run(tmp_path, "PointPush1", "trpo", returns=np.nan, costs=np.nan)
    experiments = experiments_in(tmp_path)
    (figure,) = learning_pictures(experiments)
    panels = np.array(figure.axes).reshape(3, 3)
    assert [axes.get_title() for axes in panels[0]] == ["Return", "Episode cost", "Cost rate"]
    assert panels[0, 0].get_ylabel() == "PointGoal1"
    cost_line, limit = panels[0, 1].lines
    np.testing.assert_allclose(cost_line.get_ydata(), 33.0)
    assert (limit.get_linestyle(), list(limit.get_ydata())) == ("--", [25.0, 25.0])
    band = panels[0, 1].collections[0].get_paths()[0].get_extents()
    # Student's t with one degree of freedom, times a standard error of 3
    assert (band.ymin, band.ymax) == pytest.approx((33 - 3 * 12.7062, 33 + 3 * 12.7062), abs=0.01)
    assert list(panels[0, 2].lines[-1].get_ydata()) == [0.025, 0.025]
    # the limit of another task, over shorter episodes; and a run that is not finished is dotted
    assert list(panels[2, 2].lines[-1].get_ydata()) == [0.02, 0.02]
    assert panels[2, 0].lines[0].get_linestyle() == ":"
    # where no episode has ended, the cost rate alone gives the name and the steps
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["PPO", "TRPO", "CPO (unfinished)"]
    assert panels[1, 0].get_xlim() == panels[1, 2].get_xlim()


def test_the_figures_of_the_paper_show_what_is_missing(tmp_path):
    for env in ("PointGoal2", "PointButton1", "PointButton2"):
        for seed in (0, 10):
            write_run(tmp_path, env, "cpo", seed, epochs=3, costs=20.0)
    # other lengths, variants with fewer seeds, and other algorithms are left out
    other = {"epochs": 3, "costs": 90.0}
    write_run(tmp_path, "PointButton1", "cpo", **other, frames=2000, folder="a")
    write_run(tmp_path, "PointButton1", "cpo", **other, folder="b", model={"width": 9})
    write_run(tmp_path, "PointGoal2", "focops", **other)
    (drawing,) = benchmark_figures(experiments_in(tmp_path), 12.0)
    assert drawing.name == "figure_7"
    panels = np.array(drawing.figure.axes).reshape(3, 6)
    assert panels[0, 1].get_title() == "PointGoal2\n1 of 5 algorithms, 2 seeds"
    assert panels[0, 0].get_title() == "PointGoal1\n0 of 5 algorithms"
    assert [text.get_text() for axes in panels[:, 0] for text in axes.texts] == ["no runs"] * 3
    costs = [[*line.get_ydata()] for axes in panels[1, 1:3] for line in axes.lines]
    assert costs == [[20.0] * 3, [25.0, 25.0]] * 2
    assert panels[0, 1].get_xlim()[1] >= 3000
    some = [e for e in experiments_in(tmp_path) if e.benchmark != "PointButton1"]
    assert benchmark_figures(some, 12.0) == []


def test_every_limited_cost_has_a_row(tmp_path):
    hazards = {"episode_cost_hazards": [4], "cost_hazards_rate": [0.004]}
    write_run(tmp_path, limits={"cost": 25.0, "cost_hazards": 5.0}, columns=hazards)
    experiments = experiments_in(tmp_path)
    (figure,) = learning_pictures(experiments)
    panels = np.array(figure.axes).reshape(2, 3)
    assert [axes.get_ylabel() for axes in panels[:, 0]] == [
        "PointGoal1", "PointGoal1\ncost_hazards",
    ]  # fmt: skip
    assert [list(line.get_ydata()) for line in panels[1, 1].lines] == [[4.0], [5.0, 5.0]]


def test_an_algorithm_has_one_look_everywhere_that_no_other_one_has(tmp_path):
    others = ("mine", "yours", "theirs")
    for algo in (*others, *PACKAGED):
        write_run(tmp_path, algo=algo)
    write_run(tmp_path, algo="cpo", frames=500, folder="variant")
    write_run(tmp_path, "CarGoal1", "cpo", limits={"cost": 9.0})
    everything = experiments_in(tmp_path)
    styles = algorithm_styles(everything)
    look_of = {label: (style["color"], style["marker"]) for label, style in styles.items()}
    looks = {(e.base, *look_of[e.label]) for e in everything}
    assert len(looks) == len(PACKAGED) + 3
    assert len({look[1:] for look in looks}) == len(looks)
    assert algorithm_styles([e for e in everything if e.base == "ppo"])["PPO"] == styles["PPO"]
    # those of other algorithms are far from the package's
    colours = {base: np.array(to_rgb(colour)) for base, colour, _ in looks}
    for name in others:
        for ours in PACKAGED:
            assert np.linalg.norm(colours[name] - colours[ours]) > 0.35, (name, ours)


def test_experiments_of_one_algorithm_are_told_apart(tmp_path):
    for width in range(15):
        model = {"model": {"width": width}, "frames": 3000}
        write_run(tmp_path, algo="cpo", **model, epochs=3, folder=f"w{width}")
        write_run(tmp_path, algo="cpo", **model, seed=1, folder=f"unfinished{width}")
    experiments = experiments_in(tmp_path)
    styles = algorithm_styles(experiments).values()
    assert len({(style["color"], str(style["linestyle"])) for style in styles}) == 15
    # six in a picture, and unfinished runs are dotted
    lines = [figure.axes[0].lines for figure in learning_pictures(experiments)]
    assert [len(of_picture) for of_picture in lines] == [12, 12, 6]
    assert {line.get_linestyle() for line in lines[0][1::2]} == {":"}


@pytest.mark.parametrize(
    "names",
    [
        ["a", "b", "c"],
        [f"model.input_scale=a,model.hidden_sizes={n},num_envs={n}" for n in range(12)],
        [" ".join(f"model.hidden_sizes_{n}=64" for n in range(20))],
    ],
)
def test_the_legend_is_as_wide_as_the_figure_at_most(names, tmp_path):
    figure = Figure(figsize=(12, 3), layout="constrained")
    panels = figure.subplots(1, 3)
    for name in names:
        panels[0].plot([0, 1], [0, 1], label=name)
    add_legend(figure, panels)
    save_figure(figure, tmp_path / "legend.png")
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width
    assert 0 <= box.y0 < box.y1
    # the figure has grown, so that the panels are as high as with a short legend
    assert panels[0].get_window_extent().height > 180


def front_panels(experiments):
    finals = zip(experiments, final_table(experiments).records, strict=True)
    (drawing,) = fronts(finals, algorithm_styles(experiments), 12.0)
    return drawing.figure.axes


def test_the_front_joins_what_no_other_one_beats(tmp_path):
    for algo, value, cost in (("ppo", 20.0, 60.0), ("cpo", 10.0, 20.0), ("trpo", 5.0, 40.0)):
        write_run(tmp_path, algo=algo, returns=value, costs=cost)
    write_run(tmp_path, algo="cpo", returns=3.0, costs=8.0, limits={"cost": 9.0}, folder="9")
    experiments = experiments_in(tmp_path)
    (axis,) = front_panels(experiments)
    front = next(line for line in axis.lines if line.get_color() == "0.7")
    assert list(zip(*front.get_data(), strict=True)) == [(8.0, 3.0), (20.0, 10.0), (60.0, 20.0)]
    limits = sorted(line.get_xdata()[0] for line in axis.lines if line.get_linestyle() == "--")
    assert limits == [9.0, 25.0]
    points = {c[0].get_xdata()[0]: c[0] for c in axis.containers}
    assert points[20.0].get_marker() == points[8.0].get_marker() != points[60.0].get_marker()
    # one algorithm under two limits is one line, with the limits beside its points
    line = next(line for line in axis.lines if len(line.get_xdata()) == 2 and line.get_alpha())
    assert list(zip(*line.get_data(), strict=True)) == [(8.0, 3.0), (20.0, 10.0)]
    assert {text.get_text(): text.xy for text in axis.texts} == {
        "≤ 9": (8.0, 3.0), "≤ 25": (20.0, 10.0),
    }  # fmt: skip


def test_fronts_join_nothing_that_was_trained_for_longer(tmp_path):
    for algo, epochs in (("ppo", 1), ("cpo", 1), ("trpo", 3), ("ppo_lagrangian", 3), ("mine", 9)):
        write_run(tmp_path, algo=algo, epochs=epochs, limits={} if algo == "ppo" else None)
    experiments = experiments_in(tmp_path)
    shown = {axis.get_title(): axis for axis in front_panels(experiments) if axis.get_title()}
    assert list(shown) == ["PointGoal1, 1k steps", "PointGoal1, 3k steps"]
    assert len(shown["PointGoal1, 1k steps"].containers) == 2
    labels = shown["PointGoal1, 1k steps"].get_legend_handles_labels()[1]
    assert labels == ["PPO", "CPO"]
