"""Both phases of a transfer: which runs are joined, where, and how they are drawn."""

import json
import shutil

import numpy as np
import pytest
import torch
from matplotlib.image import imread
from synthetic import SUITE, write_run

from safe_rl.cli.report import main
from safe_rl.reporting.curves import draw_transfer, find_transfers
from safe_rl.reporting.experiments import group_runs, init_sources
from safe_rl.reporting.figures import algorithm_styles
from safe_rl.reporting.recorded import find_runs
from safe_rl.runs.checkpoints import CheckpointStore

FIRST = {"returns": (4.0, 4.0, 4.0), "rates": (0.06, 0.05, 0.04)}
SECOND = {"returns": (1.0, 1.0), "costs": (50.0, 50.0), "rates": (0.09, 0.07)}


def write_first(root, seed=0, **settings):
    costs = settings.pop("costs", (30.0,) * 3)
    return write_run(root, "PointGoal1", "cpo", seed, costs=costs, **{**FIRST, **settings})


def write_second(root, source, seed=0, **settings):
    return write_run(
        root, "PointGoal2", "cpo", seed, init_from=str(source), **{**SECOND, **settings}
    )


def transfers_in(root):
    runs, _ = find_runs(root)
    sources = init_sources(runs)
    experiments, _ = group_runs(runs, SUITE, sources, root)
    return find_transfers(experiments, sources), algorithm_styles(experiments)


def only_transfer_in(root):
    (transfer,), colours = transfers_in(root)
    return transfer, draw_transfer(transfer, colours)


def solid_lines(axis):
    """What is drawn of the runs, apart from limits and the line of the change."""
    return [line for line in axis.lines if line.get_label().startswith("CPO")]


def limits(axis):
    dashed = [line for line in axis.lines if line.get_linestyle() == "--"]
    return [(list(line.get_xdata()), list(line.get_ydata())) for line in dashed]


def changes(axis):
    xs = [list(line.get_xdata()) for line in axis.lines if line.get_color() == "#333333"]
    return [x[0] for x in xs if x[0] == x[1]]


def labels(axis):
    return [text.get_text() for text in axis.texts]


def test_the_second_phase_follows_the_first(tmp_path):
    for seed, shift in ((0, 0.0), (10, 6.0)):
        first = write_first(tmp_path, seed, costs=[30.0 + shift] * 3)
        write_second(
            tmp_path, first, seed, costs=[50.0 + shift] * 2, limits={"cost": 10.0},
            env_changes={"num_steps": 500},
        )  # fmt: skip
    transfer, figure = only_transfer_in(tmp_path)
    name = "CPO (init_from=PointGoal1/cpo, cost ≤ 10)"
    title = f"PointGoal1 → PointGoal2 (num_steps=500), {name}"
    assert transfer.title == title
    assert not transfer.notes
    returns, costs, rates = figure.axes
    before, after = solid_lines(costs)
    np.testing.assert_allclose(before.get_xdata(), [1000, 2000, 3000])
    np.testing.assert_allclose(before.get_ydata(), 33.0)
    np.testing.assert_allclose(after.get_xdata(), [4000, 5000])
    np.testing.assert_allclose(after.get_ydata(), 53.0)
    bands = [band.get_paths()[0].get_extents() for band in costs.collections]
    assert [(band.ymin, band.ymax) for band in bands] == [
        pytest.approx((30.0, 36.0)), pytest.approx((50.0, 56.0)),
    ]  # fmt: skip
    assert (bands[1].xmin, bands[1].xmax) == (4000, 5000)
    assert limits(costs) == [([0, 3000], [25, 25]), ([3000, 5000], [10, 10])]
    assert limits(rates) == [([0, 3000], [0.025] * 2), ([3000, 5000], [0.02] * 2)]
    assert limits(returns) == []
    # each phase keeps its own rate
    np.testing.assert_allclose(solid_lines(rates)[1].get_ydata(), SECOND["rates"])
    for axis in figure.axes:
        assert changes(axis) == [3000]
        assert labels(axis) == ["PointGoal1", "PointGoal2\n(num_steps=500)"]
        assert axis.get_xlim() == (0, 5000)


def test_the_first_phase_ends_at_the_checkpoint(tmp_path):
    first = write_first(tmp_path)
    write_second(tmp_path, first / "checkpoints/best/checkpoint-000000002000.torchrl")
    transfer, figure = only_transfer_in(tmp_path)
    assert transfer.changes == (2000,)
    before, after = solid_lines(figure.axes[2])
    np.testing.assert_allclose(before.get_xdata(), [1000, 2000])
    np.testing.assert_allclose(before.get_ydata(), [0.06, 0.05])
    np.testing.assert_allclose(after.get_xdata(), [3000, 4000])


def test_without_a_name_the_newest_checkpoint_was_taken(tmp_path):
    first = write_first(tmp_path)
    store = CheckpointStore(
        first / "checkpoints", {"actor": torch.nn.Linear(1, 1)}, keep_last=2
    )  # the run went on for an epoch before it was killed
    for steps in (1000, 2000):
        store.save(steps)
    write_second(tmp_path, first)
    assert only_transfer_in(tmp_path)[0].changes == (2000,)


@pytest.mark.parametrize("is_recorded", [True, False])
def test_a_relative_path_counts_from_where_the_run_was_started(tmp_path, is_recorded):
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    # of the same path from both folders
    write_first(here / "runs", rates=(1.0, 1.0, 1.0))
    first = write_first(elsewhere / "runs", rates=(2.0, 2.0, 2.0))
    second = write_second(here / "runs", first.relative_to(elsewhere))
    if is_recorded:
        record = {"hydra": {"runtime": {"cwd": str(elsewhere)}}}
        (second / ".hydra" / "hydra.yaml").write_text(json.dumps(record))
    (phase,) = only_transfer_in(tmp_path)[0].first
    assert phase.runs[0].table["cost_rate"] == [2.0 if is_recorded else 1.0] * 3
    # a report reads what is in its folder, and nothing else
    assert bool(only_transfer_in(here)[0].first) is not is_recorded


def test_runs_that_were_moved_together_still_find_each_other(tmp_path):
    first = write_first(tmp_path / "before" / "runs")
    second = write_second(tmp_path / "before" / "runs", first.relative_to(tmp_path / "before"))
    record = {"hydra": {"runtime": {"cwd": str(tmp_path / "before")}}}
    (second / ".hydra" / "hydra.yaml").write_text(json.dumps(record))
    (tmp_path / "before").rename(tmp_path / "after")
    assert only_transfer_in(tmp_path / "after")[0].title.startswith("PointGoal1 → PointGoal2")


def test_a_first_run_that_is_gone(tmp_path):
    gone = write_first(tmp_path)
    shutil.rmtree(gone)
    write_second(tmp_path, gone)
    transfer, figure = only_transfer_in(tmp_path)
    assert transfer.title == "? → PointGoal2, CPO"
    (note,) = transfer.notes
    assert note == f"The run it started from is not in this folder ({gone}): drawn alone."
    assert labels(figure.axes[0]) == ["PointGoal2"]
    assert changes(figure.axes[0]) == []
    (line,) = solid_lines(figure.axes[0])
    np.testing.assert_allclose(line.get_xdata(), [1000, 2000])


def test_some_first_runs_that_are_gone(tmp_path):
    for seed in (0, 10):
        write_second(tmp_path, write_first(tmp_path, seed, costs=[30.0 + seed] * 3), seed)
    shutil.rmtree(tmp_path / "PointGoal1/cpo/seed0")
    transfer, figure = only_transfer_in(tmp_path)
    assert "seed0): the first phase is that of the others." in transfer.notes[0]
    np.testing.assert_allclose(solid_lines(figure.axes[1])[0].get_ydata(), 40.0)
    assert [run.seed for run in transfer.second.runs] == [0, 10]


def test_a_second_phase_of_one_epoch_is_a_whole_point(tmp_path):
    second = {"returns": (1.0,), "costs": (50.0,), "rates": (0.09,)}
    write_second(tmp_path, write_first(tmp_path), **second)
    _, figure = only_transfer_in(tmp_path)
    for axis in figure.axes:
        before, after = solid_lines(axis)
        assert (before.get_marker(), after.get_marker()) == ("", "o")
        # it lies on the edge of the panel
        assert not after.get_clip_on()


def test_best_checkpoints_of_different_ages(tmp_path):
    for seed, steps in ((0, 1000), (10, 3000)):
        first = write_first(tmp_path, seed)
        source = first / f"checkpoints/best/checkpoint-{steps:012d}.torchrl"
        write_second(tmp_path, source, seed)
    transfer, figure = only_transfer_in(tmp_path)
    assert transfer.changes == (1000, 3000)
    assert "after 1,000 to 3,000 steps" in transfer.notes[0]
    before, after = solid_lines(figure.axes[0])
    assert before.get_xdata()[-1] == 1000
    np.testing.assert_allclose(after.get_xdata(), [4000, 5000])
    assert changes(figure.axes[0]) == [3000]


def test_a_first_phase_of_another_algorithm_has_its_own_colour(tmp_path):
    first = write_run(tmp_path, "PointGoal1", "ppo", costs=(60.0,) * 3, **FIRST, limits={})
    write_second(tmp_path, first, frames=10**6)
    _, figure = only_transfer_in(tmp_path)
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["PPO", "CPO (unfinished)"]
    before, after = figure.axes[0].lines[:2]
    assert before.get_color() != after.get_color()
    assert after.get_linestyle() == ":"
    np.testing.assert_allclose(after.get_xdata(), [4000, 5000])
    # without a limit of its own nothing is dashed along the first phase
    assert limits(figure.axes[1]) == [([3000, 5000], [25, 25])]


def test_what_started_afresh_is_no_transfer(tmp_path):
    write_first(tmp_path)
    write_run(tmp_path, "PointGoal2", "cpo", init_from=None, **SECOND)
    assert transfers_in(tmp_path)[0] == []
    assert main([str(tmp_path)]) == 0
    assert "Transfer" not in (tmp_path / "report/report.html").read_text()
    assert "Transfer" not in (tmp_path / "report/report.md").read_text()


def test_the_page_has_a_section(tmp_path):
    write_second(tmp_path, write_first(tmp_path))
    write_second(tmp_path, "runs/<gone>", folder="other", preset="paper")
    assert main([str(tmp_path)]) == 0
    html = (tmp_path / "report/report.html").read_text()
    text = (tmp_path / "report/report.md").read_text()
    assert '<a href="#transfer">' in html
    assert 'id="transfer"' in html
    assert "is not in this folder (runs/&lt;gone&gt;): drawn alone." in html
    assert r"is not in this folder (runs/\<gone\>): drawn alone." in text
    assert "Cost rates are not joined" in html
    assert "Cost rates are not joined" in text
    assert r"PointGoal1 → PointGoal2, CPO (preset=default, init\_from=PointGoal1/cpo)](" in text
    for number in (1, 2):
        assert imread(tmp_path / f"report/transfer_{number}.png").std() > 0
