"""The run's table, read back with pandas-like rigour from plain text."""

import csv
import math

import pytest

from safe_rl.runs.table import (
    TableError,
    TableWriter,
    feasible_return,
    final_figures,
    outcome_line,
    read_table,
    violation,
)


def test_rows_are_on_disk_at_once_and_read_back_exactly(tmp_path):
    path = tmp_path / "progress.csv"
    table = TableWriter(path)
    table.write({"epoch": 1, "return": 0.1 + 0.2, "cost": math.nan})
    with path.open() as file:
        assert list(csv.DictReader(file)) == [
            {"epoch": "1", "return": "0.30000000000000004", "cost": ""}
        ]
    table.write({"epoch": 2, "return": -1e-12, "cost": 25.0})
    columns = read_table(path)
    assert columns["epoch"] == [1.0, 2.0]
    assert columns["return"] == [0.1 + 0.2, -1e-12]
    assert math.isnan(columns["cost"][0])
    assert columns["cost"][1] == 25.0


def test_columns_may_not_change(tmp_path):
    table = TableWriter(tmp_path / "progress.csv")
    table.write({"epoch": 1, "kl": 0.01})
    with pytest.raises(ValueError, match=r"\['extra'\]"):
        table.write({"epoch": 2, "kl": 0.01, "extra": 0.0})
    with pytest.raises(ValueError, match="same order"):
        table.write({"kl": 0.01, "epoch": 2})


def test_a_continued_table_keeps_the_rows_it_is_told_to(tmp_path):
    path = tmp_path / "progress.csv"
    table = TableWriter(path)
    for epoch in range(1, 6):
        table.write({"epoch": epoch})
    table = TableWriter(path, keep_rows=3)
    table.write({"epoch": 40})
    with pytest.raises(ValueError, match="other"):
        table.write({"other": 1})
    assert read_table(path)["epoch"] == [1, 2, 3, 40]
    TableWriter(path)
    with pytest.raises(ValueError, match="has not finished an epoch"):
        read_table(path)


def test_a_table_of_fewer_rows_than_are_to_be_kept_is_refused(tmp_path):
    path = tmp_path / "progress.csv"
    with pytest.raises(TableError, match="holds 0 complete rows"):
        TableWriter(path, keep_rows=1)
    path.write_text("epoch\n1\n2\n")
    with pytest.raises(TableError, match=r"holds 2 complete rows.* 3 epochs"):
        TableWriter(path, keep_rows=3)
    TableWriter(path, keep_rows=2)
    assert read_table(path) == {"epoch": [1.0, 2.0]}


def test_a_row_that_is_cut_off_is_no_row(tmp_path):
    path = tmp_path / "progress.csv"
    path.write_text("epoch,steps\n")
    assert read_table(path) == {"epoch": [], "steps": []}
    for cut_off in ("2", "2,4", "2,40"):
        path.write_text(f"epoch,steps\n1,20\n{cut_off}")
        assert read_table(path) == {"epoch": [1.0], "steps": [20.0]}
    path.write_text("\ufeffepoch,steps\n1,20\n")  # as spreadsheets save it
    assert read_table(path) == {"epoch": [1.0], "steps": [20.0]}
    path.write_text("epoch,st")
    with pytest.raises(ValueError, match="has not finished an epoch"):
        read_table(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: b.replace(b"steps", b"epoch", 1), "two columns of one name: epoch,epoch"),
        (lambda b: b.replace(b"steps", b"stepz", 1), "have the columns of the first"),
        (lambda b: b.replace(b"\n", b"\n\n", 1), "line 2 has 0 fields and the header"),
        (lambda b: b"\x80\x81" + b, "is no table: it is not text"),
        (lambda b: b.replace(b"\n1,", b"\none,", 1), "has a field that is no number"),
    ],
)
def test_a_table_that_was_changed_is_told_in_a_line(change, message, tmp_path):
    path = tmp_path / "progress.csv"
    table = TableWriter(path)
    for epoch in (1, 2):
        table.write({"epoch": epoch, "steps": 10 * epoch})
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(TableError, match=message):
        TableWriter(path, keep_rows=2).write({"epoch": 3, "steps": 30})


def test_a_violation_that_was_not_measured_is_that_of_the_mean():
    row = {"episode_cost": 30.0, "violation_cost": math.nan}
    assert violation(row, "cost", 25.0) == 5.0


def test_epochs_without_an_episode_have_no_feasible_return():
    rows = [{"episode_return": math.nan, "episode_cost": math.nan}]
    assert feasible_return(rows, {}) is None
    rows.append({"episode_return": 6.0, "episode_cost": 20.0})
    assert feasible_return(rows, {"cost": 25.0}) == 6.0


def test_final_figures_leave_out_epochs_before_and_without_episodes():
    returns = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, math.nan, 7.0]
    table = {
        "steps": [100.0 * (epoch + 1) for epoch in range(8)],
        "time_total": [1.0 + epoch for epoch in range(8)],
        "episode_return": returns,
        "episode_cost": [10.0 * value for value in returns],
        "violation_cost": [10.0 * value - 25.0 for value in returns],
        "cost_rate": [0.01 * epoch for epoch in range(8)],
    }
    # epochs 2, 3, 4, 5 and 7, whose mean is 4.2
    expected = {"episode_return": 4.2, "episode_cost": 42.0, "violation_cost": 17.0}
    expected |= {"cost_rate": 0.07, "steps_per_second": 100.0}
    assert final_figures(table, ["cost"]) == pytest.approx(expected)
    line = outcome_line(table, {}, 50, "mean")
    assert line == "Return 4.20, cost 42.0 per episode, mean of steps 201 to 800; 100 steps/s"
