"""The table of the velocity campaign: of all runs that there are, and none that there are not."""

import csv
import gzip
import re
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "docs"))

from velocity_results import ARCHIVE, PUBLISHED, velocity_page

from safe_rl.envs.velocity import VELOCITY_SUITE
from safe_rl.reporting.campaigns import PLAN, read_plan

STEPS = np.arange(20_000, 1_000_001, 20_000)


def write_run(archive, env, seed, frames=1_000_000):
    """A table with a number of its own in every epoch; returns what its last quarter comes to."""
    rng = np.random.default_rng(seed)
    returns, costs = rng.uniform(900, 3000, STEPS.size), rng.uniform(10, 40, STEPS.size)
    folder = archive / env / "ppo_lagrangian" / f"seed{seed}"
    folder.mkdir(parents=True)
    with gzip.open(folder / "progress.csv.gz", "wt") as file:
        table = csv.writer(file)
        table.writerow(["steps", "episode_return", "episode_cost", "cost_rate"])
        rows = zip(STEPS, returns, costs, costs / 1000, strict=True)
        table.writerows(row for row in rows if row[0] <= frames)
    late = STEPS > 750_000
    return returns[late].mean(), costs[late].mean(), (costs[late] > 25).mean()


def row_of(page, env):
    (row,) = re.findall(rf"^\| `{env}` \| (.*) \|$", page, re.MULTILINE)
    return row.split(" | ")


@pytest.fixture
def archive(tmp_path):
    (tmp_path / PLAN).write_text((ARCHIVE / PLAN).read_text())
    return tmp_path


def test_runs_are_averaged_over_the_last_quarter_and_missing_ones_named(archive):
    measured = np.array([write_run(archive, "SafeHopperVelocity", seed) for seed in (300, 302)])
    alone = write_run(archive, "SafeAntVelocity", 301)
    write_run(archive, "SafeAntVelocity", 302, frames=600_000)  # interrupted
    page = velocity_page(archive)
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
    assert missing.startswith("`SafeAntVelocity` (300, 302), `SafeHalfCheetahVelocity` (300, 301,")
    assert "`SafeHopperVelocity` (301)" in missing


def test_nothing_is_missing_where_all_is_done(archive):
    for cell in read_plan(archive / PLAN):
        for seed in cell.seeds:
            write_run(archive, cell.chosen["env"], seed)
    page = velocity_page(archive)
    assert "All runs are done." in page
    assert "none yet" not in page


def test_the_campaign_is_of_the_whole_family():
    cells = read_plan(ARCHIVE / PLAN)
    assert {cell.chosen["env"] for cell in cells} == set(VELOCITY_SUITE) == set(PUBLISHED)
