"""The table of the velocity campaign: of all runs that there are, and none that there are not."""

import re

import archived_runs
import numpy as np
import pytest
from velocity_tables import ARCHIVE, PUBLISHED, velocity_runs

from safe_rl.envs.velocity import VELOCITY_SUITE
from safe_rl.reporting.recorded import Run

STEPS = np.arange(20_000, 1_000_001, 20_000)


@pytest.fixture
def runs(monkeypatch):
    """Runs by environment and algorithm, and then by seed, as those of an archive."""
    found = {}
    monkeypatch.setattr(archived_runs, "runs_of", lambda _: found)
    return found


def add_run(runs, env, seed, frames=1_000_000):
    """A run with a number of its own in every epoch; returns what its last quarter comes to."""
    rng = np.random.default_rng(seed)
    returns, costs = rng.uniform(900, 3000, STEPS.size), rng.uniform(10, 40, STEPS.size)
    columns = {"steps": STEPS, "episode_return": returns, "episode_cost": costs}
    columns["cost_rate"] = costs / 1000
    epochs = frames // 20_000
    table = {name: column[:epochs].tolist() for name, column in columns.items()}
    run = Run(ARCHIVE, {}, table)
    runs.setdefault((env, "ppo_lagrangian"), {})[seed] = run
    late = STEPS > 750_000
    return returns[late].mean(), costs[late].mean(), (costs[late] > 25).mean()


def row_of(page, env):
    (row,) = re.findall(rf"^\| `{env}` \| (.*) \|$", page, re.MULTILINE)
    return row.split(" | ")


def test_runs_are_averaged_over_the_last_quarter_and_missing_ones_named(runs):
    measured = np.array([add_run(runs, "SafeHopperVelocity", seed) for seed in (1321, 4420)])
    alone = add_run(runs, "SafeAntVelocity", 2201)
    add_run(runs, "SafeAntVelocity", 4420, frames=600_000)  # interrupted
    page = velocity_runs()
    mean, deviation = measured.mean(0), measured.std(0, ddof=1)
    assert row_of(page, "SafeHopperVelocity")[:4] == [
        "2",
        f"{mean[0]:.0f} ± {deviation[0]:.0f}",
        f"{mean[1]:.1f} ± {deviation[1]:.1f}",
        f"{mean[2]:.0%}",
    ]
    ant = ["1", f"{alone[0]:.0f}", f"{alone[1]:.1f}", f"{alone[2]:.0%}"]
    assert row_of(page, "SafeAntVelocity") == [*ant, "3262 ± 80", "12.1 ± 6.6"]
    assert row_of(page, "SafeSwimmerVelocity")[:4] == ["none yet", "—", "—", "—"]
    missing = page.partition("Not run yet, or not to the end: ")[2]
    assert missing.startswith("`SafeAntVelocity` (1321, 4420), `SafeHalfCheetahVelocity` (1321, ")
    assert "`SafeHopperVelocity` (2201)" in missing


def test_published_values_are_of_the_whole_family():
    assert set(VELOCITY_SUITE) == set(PUBLISHED)
