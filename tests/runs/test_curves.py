"""The learning curves: what is drawn, not how it looks."""

import math

import numpy as np
import pytest
from matplotlib.image import imread

from safe_rl.runs.curves import learning_curves, moving_mean, save_figure

TABLE = {
    "steps": [100, 200, 300, 400, 500, 600, 700],
    "episode_return": [1.0, math.nan, 3.0, 4.0, 5.0, 6.0, 13.0],
    "episode_cost": [60.0, math.nan, 50.0, 40.0, 30.0, 20.0, 10.0],
    "episode_cost_hazards": [6.0, math.nan, 5.0, 4.0, 3.0, 2.0, 1.0],
    "cost_rate": [0.06, 0.06, 0.05, 0.04, 0.03, 0.03, 0.02],
    "cost_hazards_rate": [0.006, 0.006, 0.005, 0.004, 0.003, 0.003, 0.002],
}


def drawn(cost_limits, table=TABLE):
    return learning_curves(table, cost_limits, 1000, "title", "mean").axes


def test_a_picture_replaces_the_one_before(tmp_path):
    for limits in ({"cost": 25.0}, {}):
        figure = learning_curves(TABLE, limits, 1000, "title", "mean")
        path = save_figure(figure, tmp_path / "curves.png")
        assert imread(path).std() > 0
        assert list(tmp_path.iterdir()) == [path]


def heights(axes, style):
    return [line.get_ydata() for line in axes.lines if line.get_linestyle() == style]


@pytest.mark.parametrize(
    ("limits", "dashed"),
    [
        ({"cost": 25.0}, [25.0]),
        ({"cost": 25.0, "cost_hazards": 10.0}, [10.0, 25.0]),
        ({}, []),  # the aggregate cost is drawn
    ],
)
def test_three_panels_with_dashed_limits(limits, dashed):
    returns, costs, rates = drawn(limits)
    assert [panel.get_title() for panel in (returns, costs, rates)] == [
        "Return", "Episode cost", "Cost rate",
    ]  # fmt: skip
    assert heights(returns, "--") == []
    assert sorted(heights(costs, "--")) == [[limit, limit] for limit in dashed]
    assert sorted(heights(rates, "--")) == [[limit / 1000, limit / 1000] for limit in dashed]
    np.testing.assert_allclose(heights(rates, "-")[0], TABLE["cost_rate"])


def test_single_epochs_and_their_moving_mean_over_five():
    returns, _, _ = drawn({"cost": 25.0})
    single, mean = returns.lines
    np.testing.assert_allclose(single.get_ydata(), [1, 3, 4, 5, 6, 13])
    np.testing.assert_allclose(single.get_xdata(), [100, 300, 400, 500, 600, 700])
    np.testing.assert_allclose(mean.get_ydata(), [1, 2, 8 / 3, 13 / 4, 19 / 5, 31 / 5])


@pytest.mark.parametrize("first", [3.0, -1e20, math.nan], ids=["usual", "huge", "nan"])
def test_a_curve_forgets_an_epoch_that_is_five_epochs_ago(first):
    values = np.array([first, *range(1, 9)])
    windows = [values[max(0, end - 5) : end].mean() for end in range(1, 10)]
    np.testing.assert_allclose(moving_mean(values, 5), windows)


def test_several_costs_have_a_line_a_limit_and_a_name_each():
    _, costs, _ = drawn({"cost": 25.0, "cost_hazards": 10.0})
    assert [text.get_text() for text in costs.get_legend().get_texts()] == [
        "cost, of an epoch", "cost, mean of 5 epochs", "limit 25",
        "cost_hazards, of an epoch", "cost_hazards, mean of 5 epochs", "limit 10",
    ]  # fmt: skip
    colours = {line.get_color() for line in costs.lines if line.get_linestyle() == "--"}
    assert len(colours) == 2


def test_a_fourth_panel_has_the_multipliers_there_are():
    multipliers = {"multiplier_cost": [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]}
    *_, panel = drawn({"cost": 25.0, "cost_hazards": 10.0}, TABLE | multipliers)
    assert panel.get_title() == "Multiplier"
    (line,) = panel.lines
    assert line.get_label() == "λ of cost"
    np.testing.assert_allclose(line.get_ydata(), multipliers["multiplier_cost"])
    assert panel.get_ylim()[0] < 0  # a line at zero does not lie on the panel's edge
    assert len(drawn({"cost": 25.0})) == 3


def test_without_a_finished_episode_panels_say_so_and_have_the_steps_of_the_run():
    none = dict.fromkeys(("episode_return", "episode_cost"), [math.nan] * 7)
    panels = drawn({"cost": 25.0}, TABLE | none)
    assert [[text.get_text() for text in axes.texts] for axes in panels] == [
        ["no episode has ended"], ["no episode has ended"], [],
    ]  # fmt: skip
    assert {axes.get_xlim() for axes in panels} == {panels[2].get_xlim()}
