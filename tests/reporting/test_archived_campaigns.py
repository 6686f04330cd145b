"""The results in the repository: complete, readable, and what is said of them is what they hold."""

import re
from functools import cache

import numpy as np
import pytest
from commands import ROOT

from safe_rl.reporting.archive import RUNS as FILE
from safe_rl.reporting.archive import read_archive, read_runs

RESULTS = ROOT / "results"
PAGE = (RESULTS / "README.md").read_text()
ALL_ROWS = re.findall(r"^\| `(\S+/seed\d+)` \| (.*) \|$", PAGE, re.MULTILINE)
QUARTERS = [(run, row) for run, row in ALL_ROWS if "/limit" in run]
ROWS = [row for row in ALL_ROWS if row not in QUARTERS]
# steps that a column is of, where it is not half a million
WIDTHS = {"doggo": 2_000_000}
STOPPED = {"hard_tasks", "privileged_trials"}  # of exploration, runs that were stopped are kept too

pytestmark = pytest.mark.docs


@cache
def archives():
    """The runs of every campaign, read when a test needs them: they take six seconds."""
    return {path.parent.name: read_archive(path.parent) for path in RESULTS.glob(f"*/{FILE}")}


def test_every_run_can_be_reported_and_every_campaign_is_listed():
    runs, skipped = read_runs(RESULTS)
    assert not skipped
    assert all(run.repeating for run in runs)
    assert all(r.is_finished for r in runs if not STOPPED & {*r.directory.parts})
    campaigns = {path.name for path in RESULTS.iterdir() if path.is_dir()}
    assert {run.directory.relative_to(RESULTS).parts[0] for run in runs} <= campaigns
    listed = PAGE.partition("\n## ")[0]
    assert campaigns == set(re.findall(r"^\| `(\w+)` \|", listed, re.MULTILINE))
    # what a repository can carry, and nothing that a report does not read
    files = [path for path in RESULTS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < 40_000_000
    assert len(files) <= 60


def columns_of(run):
    return [np.array(run.table[f]) for f in ("steps", "episode_return", "episode_cost")]


@pytest.mark.parametrize(("run", "row"), ROWS)
def test_the_figures_are_those_of_the_tables(run, row):
    campaign, found = next((c, runs[run]) for c, runs in archives().items() if run in runs)
    width = WIDTHS.get(campaign, 500_000)
    steps, returns, costs = columns_of(found)
    cells, share = re.fullmatch(r"(.*) \|\s+(\d+ %)", row).groups()
    means = [cell.strip() for cell in cells.split(" |") if cell.strip()]
    assert len(means) == np.ceil(steps[-1] / width)
    for number, said in enumerate(means):
        known = (steps > number * width) & (steps <= (number + 1) * width)
        assert f"{np.nanmean(returns[known]):.1f} / {np.nanmean(costs[known]):.0f}" == said
    # short epochs are counted together, as many as have 20,000 steps
    late, number = costs[steps > 1_000_000], max(1, round(20_000 / steps[0]))
    starts = np.arange(len(late) % number or number, len(late), number)
    over = [part.mean() > 25 for part in np.split(late, starts) if len(part)]
    assert f"{np.mean(over):.0%}".replace("%", " %") == share


@pytest.mark.parametrize(("run", "row"), QUARTERS)
def test_the_figures_under_other_limits_are_those_of_tables_and_certificates(run, row):
    found = archives()["limits"][run]
    steps, returns, costs = columns_of(found)
    *quarters, certificate = row.split(" | ")
    assert len(quarters) == 4
    for number, said in enumerate(quarters):
        known = np.ceil(4 * steps / steps[-1]) == number + 1
        assert f"{np.nanmean(returns[known]):.1f} / {np.nanmean(costs[known]):.0f}" == said
    assert certificate == certified(found)


def certified(run):
    """What the certificate of a run says: the bound and the return, or by how much it is missed."""
    told = run.notes["certificate"]
    if not told["certified"]:
        return f"no, by {told['shortfalls']['mean_cost']:.1f}"
    bound = told["bounds"].get("mean_cost", {}).get("bound", np.nan)
    return f"≤ {bound:.1f} at {told['episode_return']:.1f}"


def test_there_are_rows():
    assert len(ROWS) >= 2
    assert len(QUARTERS) >= 2
