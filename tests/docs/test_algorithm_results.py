"""Tables of results: worked out by hand from made-up runs."""

import math
from pathlib import Path

import algorithm_results
import archived_runs
import pytest
from made import ALGORITHMS
from pandas import DataFrame

from safe_rl.reporting.recorded import Run


def run(seconds, pause=0, *, certified=None, **config):
    """A run of a hundred epochs: return and cost are the epoch's number and a hundred less it.

    Before the end of the third the machine stands still for a while; in the first no episode ends.
    """
    epochs = range(1, 101)
    table = {
        "steps": [10_000.0 * n for n in epochs],
        "episode_return": [math.nan, *map(float, epochs[1:])],
        "episode_cost": [math.nan, *(100.0 - n for n in epochs[1:])],
        "cost_rate": [0.05] * 100,
        "time_total": [seconds * n + pause * (n > 2) for n in epochs],
    }
    certificate = {"checkpoint": "checkpoint-000000000001.torchrl" if certified else None}
    certificate |= {"episode_return": 1.0, "episodes": 9, "level": 0.95, "bounds": {}}
    notes = {} if certified is None else {"certificate": certificate}
    return Run(Path("run"), config, table, notes)


@pytest.fixture
def compared(tmp_path, monkeypatch):
    """Makes both tables of PointGoal1 from runs by algorithm."""

    def tables(**runs):
        found = {("PointGoal1", a): dict(enumerate(many, 1)) for a, many in runs.items()}
        monkeypatch.setattr(archived_runs, "runs_of", lambda _: found)
        monkeypatch.setattr(algorithm_results, "ARCHIVE", tmp_path)
        monkeypatch.setattr(algorithm_results, "algorithms", lambda: [*runs, "missing"])
        return algorithm_results.compared("PointGoal1"), algorithm_results.timed("PointGoal1")

    return tables


@pytest.fixture
def timed(compared):
    """The table at equal times of three algorithms that have run, and of one that has not."""
    return compared(ppo=[run(2.0), run(1.0)], slow=[run(45.0)], stopped=[run(45.0, 1500)])[1]


@pytest.fixture
def rows(timed):
    """Cells by algorithm of the table at equal times."""
    assert algorithm_results.spread_of_times() == "2.0"
    lines = [line.strip("| ").split(" | ") for line in timed.splitlines() if line.startswith("| [")]
    return {line[0]: line[2:] for line in lines}


def test_what_was_learned_in_equal_times(rows):
    # two epochs in 120 s, then 6 and 13, of which the last tenth is one epoch or two
    slow = ["2.0 / 98 (0.02)", "6.0 / 94 (0.06)", "12.5 / 88 (0.13)"]
    # after 120 s the first has ended, and in 60 s the others have a single epoch; pauses do not
    # count, and what has not run has no row
    assert rows == {
        "[`ppo`](ppo.md)": ["—", "—", "—"],
        "[`slow`](slow.md)": slow,
        "[`stopped`](stopped.md)": slow,
    }


def test_times_that_say_nothing_of_most_have_no_column(timed):
    # two of three rows would be empty in the column of 60 s
    assert "| PointGoal1, `algo=` | seeds | 120 s | 300 s | 600 s |" in timed


def test_the_mean_over_seeds_in_equal_times(compared):
    # after 60 s, epochs 28 to 30 of the first are its last tenth, 55 to 60 of the second: 29 and
    # 57.5 on the mean; after 120 s the second has ended
    assert compared(ppo=[run(2.0), run(1.0)])[1].endswith(
        "| [`ppo`](ppo.md) | 2 | 43.2 / 57 (0.45) |"
    )


def test_the_limit_is_compared_with_costs_of_20000_steps():
    short = [
        {"steps": 5_000.0 * n, "episode_return": 0.0, "episode_cost": cost, "cost_rate": 0.0}
        for n, cost in enumerate([30, 30, 30, 0, 0, 0, 90, 90], 1)
    ]
    # the means of four epochs are 22.5 and 45
    assert algorithm_results._part_of(DataFrame(short), 0, 40_000)["above"] == 0.5


def test_all_pages_with_measurements_are_compared():
    assert {"ppo_lagrangian", "cal"} < set(algorithm_results.algorithms()) < set(ALGORITHMS)


def test_seeds_with_different_settings_are_not_averaged(compared):
    runs = [
        run(1.0, lagrangian={"ki": 0.1}),
        run(1.0, lagrangian={"ki": 0.2}, certified=True),
        run(1.0, lagrangian={"ki": 0.2}, certified=False, new_key=1),  # the others lack it
    ]
    table = compared(ppo=runs)[0]
    first, second = [line for line in table.splitlines() if line.startswith("| [`ppo`]")]
    assert first.startswith("| [`ppo`](ppo.md) `lagrangian.ki=0.1` | 1 |")
    assert first.endswith("| — |")
    assert second.startswith("| [`ppo`](ppo.md) `lagrangian.ki=0.2` | 2 |")
    assert second.endswith("| 1 of 2 |")
    assert table.endswith("Not run yet on PointGoal1: `missing`.")
    measured = algorithm_results.measured("ppo")
    assert "algo=ppo seed=1 frames=1_000_000 lagrangian.ki=0.1`" in measured
    assert "algo=ppo seed=2,3 frames=1_000_000 lagrangian.ki=0.2`" in measured
