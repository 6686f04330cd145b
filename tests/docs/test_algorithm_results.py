"""Tables at equal times: worked out by hand from two made-up runs."""

import gzip
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs"))

import algorithm_results

COLUMNS = "steps,episode_return,episode_cost,cost_rate,time_total"


def write(folder, algo, seed, seconds, pause=0):
    """A run of a hundred epochs: return and cost are the epoch's number and a hundred less it.

    Before the end of the third the machine stands still for a while.
    """
    path = folder / "PointGoal1" / algo / f"seed{seed}" / "progress.csv.gz"
    path.parent.mkdir(parents=True)
    rows = [
        f"{10_000 * n},{n},{100 - n},0.05,{seconds * n + pause * (n > 2)}" for n in range(1, 101)
    ]
    rows[0] = f"10000,,,0.05,{seconds}"  # no episode has ended yet
    with gzip.open(path, "wt") as table:
        table.write("\n".join([COLUMNS, *rows]))


@pytest.fixture
def rows(tmp_path, monkeypatch):
    """Cells by algorithm of the table at equal times."""
    for seed, seconds in ((1, 2.0), (2, 1.0)):
        write(tmp_path, "ppo", seed, seconds)
    write(tmp_path, "slow", 1, 45.0)
    write(tmp_path, "stopped", 1, 45.0, pause=1500)
    monkeypatch.setattr(algorithm_results, "ARCHIVE", tmp_path)
    page = algorithm_results.comparison(["ppo", "slow", "stopped", "missing"])
    assert "up to 2.0 times as long" in page
    table = page.partition("## At equal wall-clock")[2]
    lines = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| [")]
    return {line[0]: line[2:] for line in lines}


def test_what_was_learned_in_equal_times(rows):
    # after 60 s, epochs 28 to 30 of the first are its last tenth, 55 to 60 of the second: 29 and
    # 57.5 on the mean; after 120 s the second has ended
    assert rows["[`ppo`](ppo.md)"] == ["43.2 / 57 (0.45)", "—", "—", "—"]


def test_epochs_without_an_episode_show_nothing(rows):
    # a single epoch in 60 s, then 2, 6 and 13, of each of which the last tenth is one epoch or two
    cells = ["—", "2.0 / 98 (0.02)", "6.0 / 94 (0.06)", "12.5 / 88 (0.13)"]
    assert rows["[`slow`](slow.md)"] == cells


def test_pauses_do_not_count(rows):
    assert rows["[`stopped`](stopped.md)"] == rows["[`slow`](slow.md)"]


def test_what_has_not_run_has_no_row(rows):
    assert len(rows) == 3
