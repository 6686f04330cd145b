"""What of a plan is done: by counting runs that were written for it."""

import itertools
import shlex

import pytest
import yaml
from synthetic import SUITE, write_run

from safe_rl.cli.report import main
from safe_rl.cli.train import read_command
from safe_rl.envs import store_configs
from safe_rl.files import CONF
from safe_rl.reporting.campaigns import PLAN, campaign_tables, read_plan
from safe_rl.reporting.page import build_report
from safe_rl.reporting.recorded import find_runs

store_configs()
RESULTS = CONF.parent / "results"


def plan(root, *sweeps):
    root.mkdir(parents=True, exist_ok=True)
    (root / PLAN).write_text(yaml.safe_dump(list(sweeps), sort_keys=False))


def tables_of(root):
    return campaign_tables(root, find_runs(root)[0])


SWEEP = {"env": ["PointGoal1", "CarGoal1"], "algo": ["ppo", "cpo"], "seed": [0, 10], "frames": 3000}
ROWS = {"returns": (1.0, 2.0, 3.0), "costs": (1.0, 1.0, 1.0), "rates": (0.1, 0.1, 0.1)}


def test_runs_are_done_begun_or_missing(tmp_path):
    plan(tmp_path / "mine", SWEEP)
    write_run(tmp_path / "mine", "PointGoal1", "ppo", 0, **ROWS)
    write_run(tmp_path / "mine", "PointGoal1", "ppo", 10, frames=3000)
    write_run(tmp_path / "mine", "PointGoal1", "cpo", 10, **ROWS)
    # of another length, another seed, another environment; and of another campaign
    write_run(tmp_path / "mine", "CarGoal1", "ppo", 0)
    write_run(tmp_path / "mine", "CarGoal1", "ppo", 20, **ROWS)
    write_run(tmp_path / "mine", "CarPush1", "cpo", 0, **ROWS)
    write_run(tmp_path / "yours", "CarGoal1", "cpo", 0, **ROWS)
    found, skipped = tables_of(tmp_path)
    assert not skipped
    table, commands = found["mine"]
    states = {(r["env"], r["algo"]): (r["done"], r["begun"], r["missing"]) for r in table.records}
    assert states == {
        ("PointGoal1", "ppo"): ("0", "10 (33%)", "—"),
        ("PointGoal1", "cpo"): ("10", "—", "0"),
        ("CarGoal1", "ppo"): ("—", "—", "0, 10"),
        ("CarGoal1", "cpo"): ("—", "—", "0, 10"),
    }
    assert table.note == "2 of 8 runs are done, 1 have begun."
    assert [(r["runs"], r["command"]) for r in commands.records] == [
        (1, "python train.py algo=cpo env=PointGoal1 frames=3_000 seed=0"),
        (4, "python train.py -m algo=ppo,cpo env=CarGoal1 frames=3_000 seed=0,10"),
    ]


def test_other_keys_have_to_be_as_planned(tmp_path):
    limits = [{"cost": 10}, {"cost_hazards": 5, "cost": 25}]
    one = {"env": "PointGoal1", "algo": "cpo", "seed": 0, "frames": 1000}
    plan(tmp_path, {**one, "cost_limits": limits}, {**one, "loss.strength": [1.5, 2.0]})
    write_run(tmp_path, algo="cpo", limits={"cost": 10.0}, loss={"strength": 3.0}, folder="a")
    write_run(tmp_path, algo="cpo", loss={"strength": 2.0}, folder="b")
    # its command line says more than the plan
    said = ["env=PointGoal1", "algo=cpo", "+lagrangian=pid", "num_threads=1"]
    write_run(tmp_path, algo="cpo", loss={"strength": 1.5}, folder="c", overrides=said)
    ((table, commands),) = tables_of(tmp_path)[0].values()
    assert [(r["further"], r["done"]) for r in table.records] == [
        ("cost_limits={cost: 10}", "0"),
        ("cost_limits={cost_hazards: 5, cost: 25}", "—"),
        ("loss.strength=1.5", "—"),
        ("loss.strength=2", "0"),
    ]
    (first, second) = [record["command"] for record in commands.records]
    assert "cost_limits={cost_hazards: 5, cost: 25}" in shlex.split(first)
    assert "loss.strength=1.5" in shlex.split(second)


ONE = {"env": "PointGoal1", "algo": "cpo", "seed": 0, "frames": 3000}


def states(tables):
    return [(r["done"], r["begun"], r["missing"]) for r in tables[0].records]


def test_a_run_that_was_begun_again_is_still_done(tmp_path):
    plan(tmp_path, ONE)
    write_run(tmp_path, algo="cpo", **ROWS, folder="a")
    write_run(tmp_path, algo="cpo", frames=3000, folder="b")
    (tables,) = tables_of(tmp_path)[0].values()
    assert states(tables) == [("0", "—", "—")]


def test_campaigns_of_one_name_are_told_apart(tmp_path):
    for year in ("2025", "2026"):
        plan(tmp_path / year / "seeds", ONE)
    write_run(tmp_path / "2025" / "seeds", algo="cpo", **ROWS)
    found, _ = tables_of(tmp_path)
    assert {name: states(tables)[0] for name, tables in found.items()} == {
        "2025/seeds": ("0", "—", "—"), "2026/seeds": ("—", "—", "0"),
    }  # fmt: skip


def test_a_run_with_a_further_limit_is_another_one(tmp_path):
    both = {"cost": 25.0, "cost_hazards": 5.0}
    plan(tmp_path, {**ONE, "cost_limits": [{"cost": 25}, both]})
    write_run(tmp_path, algo="cpo", limits=both, **ROWS)
    (tables,) = tables_of(tmp_path)[0].values()
    assert states(tables) == [("—", "—", "0"), ("0", "—", "—")]


@pytest.mark.parametrize("chosen", ["+risk=cvar", "risk='cvar'"])
def test_a_plan_can_choose_from_a_group(chosen, tmp_path):
    plan(tmp_path, {**ONE, "risk": ["cvar", "chance"]})
    said = ["env=PointGoal1", "algo=cpo", chosen]
    write_run(tmp_path, algo="cpo", risk={"_target_": "a.CVaR"}, overrides=said, **ROWS)
    (tables,) = tables_of(tmp_path)[0].values()
    assert states(tables) == [("0", "—", "—"), ("—", "—", "0")]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("env: PointGoal1", "a list of mappings"), ("[3]", "a list of mappings"),
        ("- {env: a, algo: b, frames: 3}", "no seed"), ("{", "cannot be read"),
        ("- {env: a, algo: b, seed: x, frames: 3}", "seed takes whole numbers"),
        ("- {env: a, algo: b, seed: [1, 2], frames: 1.5}", "frames takes whole numbers"),
    ],
)  # fmt: skip
def test_an_odd_plan_is_left_out_with_its_reason(text, words, tmp_path):
    write_run(tmp_path)
    (tmp_path / PLAN).write_text(text)
    report = build_report(tmp_path, SUITE, seeds_needed=1, unfinished=False)
    assert words in report.skipped[tmp_path / PLAN]
    assert not report.campaigns


def test_a_plan_elsewhere_is_not_read(tmp_path):
    write_run(tmp_path / "runs")
    plan(tmp_path / "elsewhere", SWEEP)
    (tmp_path / "runs" / PLAN).symlink_to(tmp_path / "elsewhere" / PLAN)
    found, skipped = tables_of(tmp_path / "runs")
    assert not found
    assert "link to outside" in skipped[tmp_path / "runs" / PLAN]


def test_the_report_says_it(tmp_path, capsys):
    plan(tmp_path / "mine", SWEEP)
    write_run(tmp_path / "mine", "PointGoal1", "ppo", 0, **ROWS)
    assert main([str(tmp_path)]) == 0
    assert "mine: 1 of 8 runs are done." in capsys.readouterr().out
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| PointGoal1 | ppo | 3,000 | 0 | — | 10 |" in text


@pytest.mark.long
@pytest.mark.parametrize("path", sorted(RESULTS.rglob(PLAN)), ids=lambda path: path.parent.name)
def test_the_commands_of_what_is_missing_are_taken(path):
    ((_, commands),) = campaign_tables(path.parent, [])[0].values()
    assert sum(record["runs"] for record in commands.records) == sum(
        len(cell.seeds) for cell in read_plan(path)
    )
    # of the first one: each is composed as often as it has runs
    read_command(shlex.split(commands.records[0]["command"])[2:])


def test_every_run_of_the_comparison_is_planned():
    planned = {
        (cell.chosen["env"], cell.chosen["algo"], seed)
        for cell in read_plan(RESULTS / "algorithms" / PLAN)
        for seed in cell.seeds
    }
    runs, _ = find_runs(RESULTS / "algorithms")
    there = {(r.config["env"]["name"], r.algorithm, r.seed) for r in runs}
    assert there <= planned
    assert len(planned) == len(set(itertools.chain(planned, there)))
