"""Tables at equal times: worked out by hand from two made-up runs."""

import gzip
import json
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
def page(tmp_path, monkeypatch):
    """The page of three algorithms that have run, and of one that has not."""
    for seed, seconds in ((1, 2.0), (2, 1.0)):
        write(tmp_path, "ppo", seed, seconds)
    write(tmp_path, "slow", 1, 45.0)
    write(tmp_path, "stopped", 1, 45.0, pause=1500)
    monkeypatch.setattr(algorithm_results, "ARCHIVE", tmp_path)
    return algorithm_results.comparison(["ppo", "slow", "stopped", "missing"])


@pytest.fixture
def rows(page):
    """Cells by algorithm of the table at equal times."""
    assert "up to 2.0 times as long" in page
    table = page.partition("## At equal wall-clock")[2]
    lines = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| [")]
    return {line[0]: line[2:] for line in lines}


def test_what_was_learned_in_equal_times(rows):
    # after 120 s the first has ended, and in 60 s the others have a single epoch
    assert rows["[`ppo`](ppo.md)"] == ["—", "—", "—"]


def test_times_that_say_nothing_of_most_have_no_column(page):
    # two of three rows would be empty in the column of 60 s
    assert "| PointGoal1, `algo=` | seeds | 120 s | 300 s | 600 s |" in page


def test_the_mean_over_seeds_in_equal_times(tmp_path, monkeypatch):
    for seed, seconds in ((1, 2.0), (2, 1.0)):
        write(tmp_path, "ppo", seed, seconds)
    monkeypatch.setattr(algorithm_results, "ARCHIVE", tmp_path)
    # after 60 s, epochs 28 to 30 of the first are its last tenth, 55 to 60 of the second: 29 and
    # 57.5 on the mean; after 120 s the second has ended
    timed = algorithm_results.comparison(["ppo"]).partition("## At equal wall-clock")[2]
    assert "| [`ppo`](ppo.md) | 2 | 43.2 / 57 (0.45) |\n" in timed


def test_epochs_without_an_episode_show_nothing(rows):
    # two epochs in 120 s, then 6 and 13, of which the last tenth is one epoch or two
    assert rows["[`slow`](slow.md)"] == ["2.0 / 98 (0.02)", "6.0 / 94 (0.06)", "12.5 / 88 (0.13)"]


def test_pauses_do_not_count(rows):
    assert rows["[`stopped`](stopped.md)"] == rows["[`slow`](slow.md)"]


def test_what_has_not_run_has_no_row(rows):
    assert len(rows) == 3


def test_seeds_with_different_settings_are_not_averaged(tmp_path, monkeypatch):
    for seed, gain, certified in ((1, 0.1, None), (2, 0.2, True), (3, 0.2, False)):
        write(tmp_path, "ppo", seed, 1.0)
        folder = tmp_path / "PointGoal1" / "ppo" / f"seed{seed}"
        later = "new_key: 1\n" if seed == 3 else ""  # which the others had not yet
        (folder / "config.yaml").write_text(f"seed: {seed}\nlagrangian: {{ki: {gain}}}\n{later}")
        if certified is not None:
            (folder / "certificate.json").write_text(json.dumps({"certified": certified}))
    monkeypatch.setattr(algorithm_results, "ARCHIVE", tmp_path)
    table = algorithm_results.comparison(["ppo"]).partition("## At equal wall-clock")[0]
    first, second = [line for line in table.splitlines() if line.startswith("| [`ppo`]")]
    assert first.startswith("| [`ppo`](ppo.md) `lagrangian.ki=0.1` | 1 |")
    assert first.endswith("| — |")
    assert second.startswith("| [`ppo`](ppo.md) `lagrangian.ki=0.2` | 2 |")
    assert second.endswith("| 1 of 2 |")
    measured = algorithm_results.measured("ppo")
    assert "algo=ppo seed=1 frames=1_000_000 lagrangian.ki=0.1`" in measured
    assert "algo=ppo seed=2,3 frames=1_000_000 lagrangian.ki=0.2`" in measured
