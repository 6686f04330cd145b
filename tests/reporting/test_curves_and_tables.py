"""Curves over seeds, and tables as they are written, of chosen numbers."""

import csv

import numpy as np
import pytest
from synthetic import experiments_in, write_run

from safe_rl.reporting.archive import read_runs
from safe_rl.reporting.curves import average
from safe_rl.reporting.scoring import final_record
from safe_rl.reporting.tables import Table, spread


def test_curves_are_means_over_seeds_on_common_steps(tmp_path):
    write_run(tmp_path, seed=0, returns=[0.0, 2.0, 4.0], rates=[0.1, 0.2, 0.3], frames=0)
    write_run(tmp_path, seed=1, returns=[10.0, 12.0], rates=[0.3, 0.6], frames=0)
    runs, _ = read_runs(tmp_path)
    curve = average(runs, "cost_rate", smooth=False)
    # until the shorter one ends, with as many points as the longer one has epochs
    np.testing.assert_allclose(curve.steps, [1000, 1500, 2000])
    np.testing.assert_allclose(curve.mean, [0.2, 0.3, 0.4])
    # two seeds: Student's t with one degree of freedom, times the standard error
    reach = 12.706205 * np.array([0.1, 0.15, 0.2])
    np.testing.assert_allclose(curve.low, curve.mean - reach)
    np.testing.assert_allclose(curve.high, curve.mean + reach)
    alone = average(runs[:1], "episode_return", smooth=True)
    np.testing.assert_allclose(alone.mean, [0.0, 1.0, 2.0])
    assert np.isnan(alone.low).all()
    assert average(runs, "no_such_column", smooth=False) is None


def test_a_curve_begins_where_all_of_its_runs_have_and_bridges_epochs_without_an_episode(tmp_path):
    nan = float("nan")
    write_run(tmp_path, seed=0, returns=[0.0, 2.0, 4.0, nan, 8.0])
    write_run(tmp_path, seed=1, returns=[nan, nan, 14.0, 16.0, 18.0])
    curve = average(read_runs(tmp_path)[0], "episode_return", smooth=False)
    # what comes before is of one seed alone, and no mean over seeds
    np.testing.assert_allclose(curve.steps[[0, -1]], [3000, 5000])
    np.testing.assert_allclose(curve.mean, 9.0 + (curve.steps - 3000) / 500)


def test_a_curve_ends_at_the_final_score(tmp_path):
    write_run(tmp_path, costs=[1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 65.0])
    (experiment,) = experiments_in(tmp_path)
    curve = average(experiment.runs, "episode_cost", smooth=True)
    assert curve.mean[-1] == pytest.approx(25.0)
    assert curve.mean[-1] == pytest.approx(final_record(experiment, ["cost"])["episode_cost"])


def test_tables_write_all_fields_and_show_the_chosen(tmp_path):
    records = [
        {"name": "a&b", "x": 1.25, "x_std": 0.5}, {"name": "=b", "x": float("nan"), "more": "\t7"},
        {"name": "c", "x": 3.0},
    ]  # fmt: skip
    looks = {"a&b": "best", "c": "bad"}
    columns = {"name": "{name}", "x": spread("x", 1)}
    marks = {"x": lambda r: looks.get(r["name"], "")}
    table = Table("scores", "Scores", columns, records, marks=marks)
    assert [line for line in table.latex().splitlines() if "&" in line] == [
        r"name & x \\", r"a\&b & \textbf{1.2~$\pm$ 0.5} \\",
        r"=b & -- \\", r"c & 3.0 $\triangle$ \\",
    ]  # fmt: skip
    table.write_csv(tmp_path / "scores.csv")
    with (tmp_path / "scores.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows == [
        {"name": "a&b", "x": "1.25", "x_std": "0.5", "more": ""},
        # no formula for a spreadsheet
        {"name": "'=b", "x": "", "x_std": "", "more": "'\t7"},
        {"name": "c", "x": "3.0", "x_std": "", "more": ""},
    ]


def test_steps_beyond_the_end_of_training_are_no_longer_training(tmp_path):
    # epochs of 1000 steps, until there are at least 2500
    for algo, epochs in (("ppo", 3), ("cpo", 4), ("trpo", 2)):
        write_run(tmp_path, algo=algo, epochs=epochs, frames=2500)
    found = {e.algorithm: (e.runs[0].length, e.runs[0].steps) for e in experiments_in(tmp_path)}
    assert found == {"PPO": (2500, 3000), "CPO": (2500, 4000), "TRPO": (2000, 2000)}
