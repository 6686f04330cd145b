"""Final scores, slates and rankings of runs whose numbers are chosen."""

import numpy as np
import pytest
from synthetic import SUITE, experiments_in, marks, texts_of, write_run

from safe_rl.reporting.page import ReportOptions, build_report
from safe_rl.reporting.scoring import (
    complete_slates,
    final_record,
    final_table,
    paper_table,
    slate_table,
)
from safe_rl.scores.benchmark import REFERENCE, SLATES


def test_final_scores_are_means_and_deviations_over_seeds(tmp_path):
    # seven epochs, of which the last five count for return and cost and the last for the rate
    early = (900.0, 900.0)
    for seed, shift in ((0, -1.0), (10, 0.0), (20, 4.0)):
        returns = (*early, *(10.0 + shift + k for k in (-2, -1, 0, 1, 2)))
        costs = (*early, *[20.0 + shift] * 5)
        rates = (*[9.0] * 6, 0.02 + shift / 1000)
        write_run(tmp_path, "CarGoal1", "ppo", seed, returns=returns, costs=costs, rates=rates)
    (experiment,) = experiments_in(tmp_path)
    record = final_record(experiment, ["cost"])
    # shifts -1, 0, 4: mean 1, variance (4 + 1 + 9) / 2
    assert record["episode_return"] == pytest.approx(11.0)
    assert record["episode_return_std"] == pytest.approx(7**0.5)
    assert record["episode_cost"] == pytest.approx(21.0)
    assert record["cost_rate"] == pytest.approx(0.021)
    assert record["cost_rate_std"] == pytest.approx(7**0.5 / 1000)
    assert (record["seeds"], record["steps"], record["satisfies"]) == (3, 7000, True)
    table = final_table([experiment])
    assert list(table.columns)[-2:] == ["paper, 10M steps", "later work, 10M steps"]
    (row,) = table.rows()
    assert [cell.text for cell in row] == [
        "PPO", "21.0\xa0± 2.6", "25", "11.00\xa0± 2.65", "0.0210\xa0± 0.0026", "3", "7,000",
        "25.49 / 54.218 / 0.054", "33.4 / 58.1",
    ]  # fmt: skip


def test_the_bias_of_critics_is_that_of_the_final_epochs(tmp_path):
    biases = {"critic_bias_cost": [900.0, *[4.0, "", 6.0, 4.0, 6.0]]}
    write_run(tmp_path, algo="cpo", columns=biases, epochs=6)
    biases = {"critic_bias_cost": [0.0] * 5 + [5.0]}
    write_run(tmp_path, algo="cpo", seed=1, columns=biases, epochs=6)
    write_run(tmp_path, algo="ppo", epochs=6)
    table = final_table(experiments_in(tmp_path))
    place = list(table.columns).index("critics' bias")
    assert [row[place].text for row in table.rows()] == ["—", "+3.0"]  # of 5 and 1
    assert table.records[1]["critic_bias_cost_std"] == pytest.approx(8**0.5)


def test_published_values_stand_only_beside_what_they_are_values_of(tmp_path):
    write_run(tmp_path, algo="ppo_lagrangian", limits={"cost": 10.0}, folder="other limit")
    write_run(tmp_path, algo="ppo", env_changes={"hazards_num": 3}, folder="other environment")
    write_run(tmp_path, algo="trpo")
    write_run(tmp_path, algo="cpo", init_from="runs/PointGoal2/cpo/seed0")
    gym = {"_target_": "some.family", "id": "Pendulum-v1", "name": "PointGoal2"}
    write_run(tmp_path, "PointGoal2", "trpo_lagrangian", env_changes=gym)
    write_run(tmp_path, "CarGoal1", "ppo", transforms={"action_repeat": {"k": 4}})
    records = [(e.algorithm, final_record(e, ["cost"])) for e in experiments_in(tmp_path)]
    assert [(name, r["later_cost"]) for name, r in records if "later_cost" in r] == [("TRPO", 45.9)]
    assert not any("paper_episode_return" in record for _, record in records)


def test_the_best_is_sought_among_those_that_keep_their_limits(tmp_path):
    for algo, value, cost, rate in (
        ("ppo", 20.0, 60.0, 0.06),
        ("ppo_lagrangian", 10.0, 25.0, 0.02),
        ("trpo_lagrangian", 10.0, 20.0, 0.03),
        ("cpo", 12.0, 24.0, 0.04),
    ):
        write_run(tmp_path, algo=algo, returns=value, costs=cost, rates=rate)
    # other limits are another problem
    write_run(tmp_path, algo="trpo", returns=90.0, limits={"cost": 50.0})
    write_run(tmp_path, algo="mine", returns=99.0, costs=60.0, limits={})
    table = final_table(experiments_in(tmp_path))
    assert [row["$d$"] for row in texts_of(table)] == ["25", "25", "50", "25", "25", "—"]
    assert marks(table, "$J_c$") == ["bad", "", "", "", "", ""]
    assert marks(table, "$J_r$") == ["", "", "", "", "best", ""]
    assert marks(table, r"$\rho_c$") == ["", "best", "", "", "", ""]


def test_seeds_that_have_not_come_equally_far_are_not_ranked_with_those_that_have(tmp_path):
    """Where unfinished runs are to count, the longest of an experiment does not stand for all."""
    long = {"epochs": 10, "costs": 1.0}
    write_run(tmp_path, algo="cpo", **long)
    write_run(tmp_path, algo="cpo", seed=10, returns=9.0, frames=10_000)
    for seed in (0, 10):
        for algo in ("trpo_lagrangian", "ppo_lagrangian"):
            write_run(tmp_path, algo=algo, seed=seed, **long)
    report = build_report(tmp_path, SUITE, ReportOptions(seeds=2, unfinished=True))
    blocks = {block.name: block for part in report.sections.values() for block in part}
    final = blocks["final_PointGoal1"]
    steps = [row["steps"] for row in texts_of(final)]
    assert steps == ["10,000", "10,000", "1,000 to 10,000"]
    assert marks(final, "$J_r$") == ["best", "best", ""]
    assert blocks["fronts"].shows.endswith("PointGoal1, 10k steps: PPO-Lagrangian, TRPO-Lagrangian")
    slate = blocks["slate_shared"]
    assert [row[2].text for row in slate.rows()] == ["10,000", "10,000", "1,000 to 10,000"]
    assert marks(slate, r"$\bar J_r$") == ["best", "best", ""]
    # and it is not said to be finished
    states = {(r["algorithm"], r["seed"]): r["state"] for r in blocks["runs"].records}
    assert states["CPO", 10] == "10%"
    assert list(states.values()).count("finished") == 5


def test_a_limit_on_another_measure_is_judged_by_that_measure(tmp_path):
    # mean costs that keep d = 25 and a measure that does not, and the other way round
    over = {"violation_cost": [-900, -900, "", 9, 11, "", 10]}
    below = {"violation_cost": [900, 900, -4, -6, "", "", ""]}
    risk = {"_target_": "safe_rl.objectives.CVaR"}
    write_run(tmp_path, algo="mine", epochs=7, costs=10.0, columns=over, risk=risk)
    write_run(tmp_path, algo="yours", epochs=7, costs=40.0, columns=below, risk=risk)
    # limits=paper: an estimate of the mean from rows shorter than episodes is no other measure
    write_run(tmp_path, algo="cpo", epochs=7, costs=10.0, columns=over)
    experiments = experiments_in(tmp_path)
    records = {e.algorithm: final_record(e, ["cost"]) for e in experiments}
    found = {name: (r["excess_cost"], r["satisfies"]) for name, r in records.items()}
    assert found == {"mine": (10.0, False), "yours": (-5.0, True), "CPO": (-15.0, True)}
    table = final_table(experiments)
    assert marks(table, "$J_c$") == ["", "", ""]
    place = list(table.columns).index("limited measure")
    measures = [(row[place].text, row[place].mark) for row in table.rows()]
    assert measures == [("—", ""), ("35.0", "bad"), ("20.0", "")]
    # published costs are means: they are no unit of another measure's violation
    ((_, members),) = complete_slates(experiments, 1)
    assert [e.algorithm for (e,) in members] == ["CPO"]
    assert [e.is_published_problem for e in experiments] == [True, False, False]


def test_a_limit_that_the_published_ppo_keeps_has_no_normalised_violation(tmp_path):
    for name, limit in (("cpo", 25.0), ("ppo", REFERENCE["PointGoal1"].episode_cost)):
        write_run(tmp_path, algo=name, costs=limit + 1, limits={"cost": limit})
    ((_, members),) = complete_slates(experiments_in(tmp_path), 1)
    assert [e.algorithm for (e,) in members] == ["CPO"]


def write_slate(root, algo, multiples):
    """Final scores that are multiples of the reference: one multiple per environment and seed."""
    for index, env in enumerate(SLATES["SG6"]):
        reference = REFERENCE[env]
        for seed, shift in ((0, -0.1), (10, 0.0), (20, 0.1)):
            factor = multiples[index] + shift
            write_run(
                root, env, algo, seed,
                returns=factor * reference.episode_return,
                costs=25 + factor * (reference.episode_cost - 25),
                rates=factor * reference.cost_rate,
            )  # fmt: skip


MULTIPLES = (0.2, 0.4, 0.6, 0.8, 1.0, 3.0)


def test_a_complete_slate_is_averaged_over_environments_and_seeds(tmp_path):
    write_slate(tmp_path, "cpo", MULTIPLES)
    experiments = experiments_in(tmp_path)
    ((name, members),) = complete_slates(experiments, 3)
    assert (name, [e.benchmark for e in members[0]]) == ("SG6", list(SLATES["SG6"]))
    assert [name for name, _ in complete_slates(experiments, 4)] == ["shared"]
    table = slate_table(name, members)
    assert "10,000,000 (Doggo: 100,000,000 steps)" in table.note
    (record,) = table.records
    scores = [record[score] for score in ("episode_return", "violation", "cost_rate")]
    assert scores == pytest.approx([1.0, 1.0, 1.0])
    assert record["runs"] == 18
    # 18 values; four are left out at each end: 0.1 0.2 0.3 0.3 | 0.4 ... 0.9 | 1.1 2.9 3.0 3.1
    kept = [0.4, 0.5, 0.5, 0.6, 0.7, 0.7, 0.8, 0.9, 0.9, 1.0]
    middle, low, high = (record[f"iqm_episode_return{end}"] for end in ("", "_low", "_high"))
    assert middle == pytest.approx(np.mean(kept))
    # the seeds of an environment are within 0.1 of each other, and environments stay apart
    assert middle - 0.1 <= low < middle < high <= middle + 0.1
    ours = dict(zip(table.columns, table.rows()[0], strict=True))
    assert ours[r"$\bar J_r$"].text == "1.000"
    assert ours[r"paper $\bar J_r$"].text == "1.021"
    assert ours[r"paper $\bar M_c$"].text == "0.573"
    assert ours["steps"].text == "1,000"
    assert ours[r"IQM $\bar J_r$"].text.startswith("0.700 [0.")
    assert marks(table, r"$\bar M_c$") == ["bad"]


@pytest.mark.parametrize(
    "changes",
    [
        {"init_from": "runs/PointGoal1/cpo/seed0"}, {"env_changes": {"size": 3}},
        {"limits": {"cost_hazards": 25.0}}, {"frames": 10**6},
        {"transforms": {"early_termination": {"budgets": {"cost": 24}}}},
    ],
)  # fmt: skip
def test_what_counts_towards_no_slate(changes, tmp_path):
    """Changed problems, continued runs, limits on other costs, and runs that go on."""
    for env in SLATES["SG6"]:
        write_run(tmp_path, env, "cpo", **changes)
    result = build_report(tmp_path, SUITE, ReportOptions(seeds=1))
    assert "normalised" not in result.sections


def test_what_has_finished_no_episode_is_neither_best_nor_worse_than_others(tmp_path):
    nothing = float("nan")
    for seed in (0, 10):
        write_run(tmp_path, algo="ppo", seed=seed, returns=nothing, costs=nothing, limits={})
        write_run(tmp_path, algo="trpo", seed=seed, limits={})
        write_run(tmp_path, algo="trpo_lagrangian", seed=seed, returns=0.5 + seed, limits={})
        write_run(tmp_path, algo="cpo", seed=seed, returns=nothing, costs=nothing)
        write_run(tmp_path, algo="ppo_lagrangian", seed=seed, returns=2.0 + seed, costs=20.0)
        write_run(tmp_path, algo="mine", seed=seed, returns=2.0 + seed, costs=90.0)
    experiments = experiments_in(tmp_path)
    table = final_table(experiments)
    found = dict(zip((r["algorithm"] for r in table.records), marks(table, "$J_r$"), strict=True))
    assert [name for name, mark in found.items() if mark] == ["PPO-Lagrangian", "TRPO-Lagrangian"]
    kept = {r["algorithm"]: r["satisfies"] for r in table.records}
    assert (kept["CPO"], kept["PPO-Lagrangian"], kept["mine"]) == (None, True, False)
    own = [[e] for e in experiments if e.algorithm in ("CPO", "PPO-Lagrangian", "mine")]
    assert marks(slate_table("SG6", own), r"$\bar M_c$") == ["", "", "bad"]


def test_the_papers_tables_have_what_there_is_beside_the_published_values(tmp_path):
    # PPO's own published scores on two environments, and an algorithm with half of each
    for env in ("PointGoal1", "CarGoal2"):
        scores = REFERENCE[env]
        for algo, factor in (("ppo", 1.0), ("cpo", 0.5), ("trpo_lagrangian", 0.5)):
            cost = scores.episode_cost if algo == "ppo" else 20.0
            rate = scores.cost_rate * (factor if algo != "cpo" else 0.6)
            value = factor * scores.episode_return
            write_run(tmp_path, env, algo, returns=value, costs=cost, rates=rate)
    # twice as long, it dominates nothing, and neither does one with another limit
    write_run(tmp_path, algo="ppo_lagrangian", epochs=2, returns=99.0, costs=20.0, rates=0.0)
    write_run(tmp_path, algo="trpo", returns=99.0, limits={"cost": 50.0})
    for env in {*SLATES["SGCar"]} - {"CarGoal2"}:
        write_run(tmp_path, env, "ppo")
    rows = texts_of(paper_table(experiments_in(tmp_path)))
    slates = {row["slate"] for row in rows}
    assert slates == {"SG18", "SG12", "SG6", "SG1", "SG2", "SGPoint", "SGCar"}
    ppo, _, trpo, cpo = (row for row in rows if row["slate"] == "SGPoint")
    figures = [r"$\bar J_r$", r"$\bar M_c$", r"$\bar \rho_c$"]
    assert [ppo[name] for name in figures] == ["1.000"] * 3
    assert [cpo[name] for name in figures] == ["0.500", "0.000", "0.600"]
    whole, _, part = (row for row in rows if row["slate"] == "SGCar")
    assert [whole[f"paper {name}"] for name in figures] == ["1.000"] * 3
    # published averages are over all environments of a slate
    assert {part[f"paper {name}"] for name in figures} == {"—"}
    assert (cpo["environments"], cpo["dominated by"]) == ("1 of 6", "TRPO-Lagrangian")
    assert (trpo["dominated by"], ppo["dominated by"]) == ("", "")
