"""Tables and sentences on results are those of the archived runs."""

import re

import numpy as np
import pandas
import pytest
import result_tables as results
from commands import ROOT


def said(page):
    """A page without its line breaks."""
    return " ".join((ROOT / page).read_text().split())


@pytest.fixture(scope="module")
def held_out():
    """Figures of the constrained runs of three million steps."""
    runs = results.runs("held_out")
    of_runs = pandas.DataFrame(results.figures(run, 5e5, 1e6) for run in runs.run)
    tables = [pandas.DataFrame(run.table) for run in runs.run]
    of_runs["first"] = [t[t.steps <= 1e6].episode_cost.mean() for t in tables]
    return runs.reset_index(drop=True).join(of_runs)


def test_what_is_said_of_the_limit(held_out):
    kept, over, end = (
        (held_out[key] <= top).sum() for key, top in (("since", 25), ("rate", 0.025), ("cost", 25))
    )
    first = held_out.groupby(["environment", "algorithm"])["first"].mean()
    page, readme = said("docs/results.md"), said("README.md")
    total = len(held_out)
    assert f"{kept} of the {total} runs have a mean cost of at most 25" in page
    assert f"{total - over} of the {total} are above the limit" in page
    assert f"cost {first.min():.0f} to {first.max():.0f} per episode" in page
    assert f"{kept} of the {total} constrained runs" in readme
    assert f"over the whole training {total - over} of them are above it" in readme
    certified = int(results.certified(held_out).split()[0])
    words = f"{end} runs are within the limit over the last half million steps, and {certified}"
    assert words in page
    highest = re.search(r"to ([\d.]+) \(", results.new_episodes(held_out))[1]
    assert f"a mean cost of at most {highest}" in readme


def test_what_the_pages_of_algorithms_say_of_certificates(held_out):
    for algo in ("ppo_lagrangian", "trpo_lagrangian", "cpo"):
        told = results.certified(held_out[held_out.algorithm == algo]).partition(",")[0]
        assert f"{told} runs of" in said(f"docs/algorithms/{algo}.md")


def test_what_is_said_of_hard_tasks():
    held = results.runs("held_actions").query("seed not in (110, 111)")
    found = {results.certified(group).split(",")[0] for _, group in held.groupby("environment")}
    assert found == {"4 of 4", "3 of 3", "1 of 1"}
    for env in ("PointGoal2", "PointButton1", "PointPush1"):
        returns = results.certified(held.query("environment == @env")).partition("at ")[2]
        assert f"{returns} on {env}" in said("README.md")
    goal = held.query("environment == 'PointGoal2'")
    assert f"_c {results.summary(goal, 5e5)['rate']})" in said("README.md")


def test_the_first_command_of_readme():
    six = results.runs("first_million").query("name == 'betting'")
    returns = results.certified(six).removeprefix("6 of 6, at ")
    costs = results.new_episodes(six).partition(" (")[0]
    assert f"at returns of {returns}, and in 2,000" in said("docs/results.md")
    assert f"mean costs of {costs}." in said("docs/results.md")


def test_how_many_episodes_exceed_the_limit_under_certified_policies(held_out):
    tests = [test for run in held_out.run for test in run.notes.get("evaluations", ())]
    found = [test["estimates"] for test in tests if test["checkpoint"] == "certified"]
    shares = [e["over_limit_cost"]["value"] for e in found if e["episode_cost"]["value"] >= 22]
    assert np.mean(shares) == pytest.approx(1 / 3, abs=0.03)
    assert "about a third of the episodes cost more than" in said("docs/concepts.md")


def test_how_far_off_the_cost_critics_are():
    chosen = "environment == 'PointGoal1' and algorithm == 'sac_lagrangian'"
    runs = results.runs("held_out").query(chosen).run
    told = [np.mean(run.table["policy_cost_qvalue"][-100:]) * 1000 * (1 - 0.99) for run in runs]
    costs = [results.figures(run, 5e5)["cost"] for run in runs]
    words = f"{min(told):.0f} to {max(told):.0f} on PointGoal1, where episodes cost"
    assert f"{words} {min(costs):.0f} to {max(costs):.0f}." in said("docs/off_policy.md")


def test_every_environment_has_results_as_readme_says():
    rows = results.coverage().splitlines()[2:]
    runs = [sum(map(int, re.findall(r"(\d+) ×", row))) for row in rows]
    assert len(runs) == 18
    assert min(runs) > 0
    few = [row.split(" |")[0] for row, number in zip(rows, runs, strict=True) if number <= 3]
    assert len(few) == 6
    assert all(name.startswith("| Doggo") for name in few)
