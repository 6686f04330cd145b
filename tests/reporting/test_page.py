"""The report as files, and the page as a browser shows it."""

import base64
import json
import re
from html import unescape

import numpy as np
import pandas
import pytest
from matplotlib.image import imread
from synthetic import EVALUATION, estimate, experiments_in, marks, texts_of, write_run

from safe_rl.cli.report import main
from safe_rl.reporting.archive import read_archive
from safe_rl.reporting.run_tables import evaluation_table
from safe_rl.reporting.scoring import complete_slates, slate_table
from safe_rl.runs.run import Run

ROWS = {"returns": (1.0, 2.0, 3.0), "rates": (0.06, 0.05, 0.04)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two algorithms and seeds on PointGoal1, one run elsewhere that is not finished."""
    root = tmp_path_factory.mktemp("experiments")
    for algo, costs in (("ppo", (60.0, 50.0, 55.0)), ("ppo_lagrangian", (30.0, 20.0, 20.0))):
        for seed in (0, 10):
            rows = {**ROWS, "costs": np.array(costs) + seed / 10}
            directory = write_run(root, "PointGoal1", algo, seed, **rows)
    (directory / "evaluation.json").write_text(json.dumps(EVALUATION))
    write_run(root, "Mine", "cpo", 0, frames=10**6, overrides=["env=Mine", "+note=<b>&"])
    (write_run(root, folder="unbegun") / "progress.csv").unlink()
    return root


@pytest.fixture(scope="module")
def report(folder):
    assert main([str(folder), "seeds=2", "title=A <title>"]) == 0
    return folder / "report"


def texts(markup):
    """What stands between the tags."""
    parts = (unescape(part) for part in re.split(r"<[^>]*>", markup))
    return [part.strip() for part in parts if part.strip()]


class Page:
    """What a page says: cells of tables by row, attributes of elements, text without markup."""

    def __init__(self, path):
        self.html = re.sub(r"<style.*?</style>", "", path.read_text(), flags=re.DOTALL)
        rows = re.findall(r"<tr\b.*?</tr>", self.html, re.DOTALL)
        cells = (re.findall(r"<t[dh]\b.*?</t[dh]>", row, re.DOTALL) for row in rows)
        self.rows = [["".join(texts(cell)) for cell in row] for row in cells]
        self.words = texts(self.html)

    def of(self, tag):
        found = re.findall(rf"<{tag}\b([^>]*)>", self.html)
        return [dict(re.findall(r'([\w-]+)="([^"]*)"', attributes)) for attributes in found]


def test_everything_is_written(report):
    names = {path.name for path in report.iterdir()}
    assert {"report.html", "tables.tex", "runs.csv", "evaluations.csv"} <= names
    # a table and a figure of every kind that these runs give reason for, and no other
    kinds = {re.match("[a-z]+", name)[0] for name in names}
    assert kinds == {
        "report", "runs", "tables", "evaluations", "final", "curves", "fronts",
        "slate", "paper", "left",
    }  # fmt: skip
    for picture in report.glob("*.png"):
        assert imread(picture).std() > 0


def test_page_and_latex_say_the_same(report):
    page, text = Page(report / "report.html"), (report / "tables.tex").read_text()
    counts = ("runs", "environments", "algorithms", "experiments")
    shown = [page.words[page.words.index(name) + 1] for name in counts]
    assert shown == ["4 of 5 finished", "2", "3", "3"]
    # a row of the table of final scores, and one of an evaluation
    (row,) = (r for r in page.rows if r[0] == "PPO" and r[2:3] + r[5:7] == ["25", "2", "3,000"])
    assert row[1:5] == ["55.5\xa0± 0.7▲", "25", "2.00\xa0± 0.00", "0.0400\xa0± 0.0000"]
    assert (
        r"PPO & 55.5~$\pm$ 0.7 $\triangle$ & 25 & 2.00~$\pm$ 0.00 & "
        r"0.0400~$\pm$ 0.0000 & 2 & 3,000 &"
    ) in text
    (row,) = (r for r in page.rows if "mean actions, x=1, 0% known layouts" in r)
    assert row[-5:-2] == ["12.00 [11.00, 13.00]", "21.0 [20.0, 22.0]", "25"]
    assert row[-2:] == ["25.0%", "10.0%: 70.0 [69.0, 71.0]"]


def test_the_page_is_for_everybody(report):
    page = Page(report / "report.html")
    assert all(th.get("scope") in ("col", "row") for th in page.of("th"))
    texts = [image["alt"] for image in page.of("img")]
    assert all("PointGoal1" in text or "trained on" in text or "Mine" in text for text in texts)
    assert len(set(texts)) == len(texts)
    # what is over its limit is told by a sign with a name, not by colour alone
    marked = [e for e in page.of("b") if e.get("class") == "flag"]
    assert marked
    assert all(mark["aria-label"] == "over the limit" for mark in marked)


def test_an_evaluation_shows_every_limit(tmp_path):
    limits = {"cost_hazards": 5.0, "cost_vases": 30.0}
    columns = {"episode_cost_hazards": [4.0], "cost_hazards_rate": [0.1], "violation_cost": [-9.0]}
    directory = write_run(tmp_path, "PointGoal1", "ppo", limits=limits, columns=columns)
    estimates = {"episode_return": estimate(12.0), "episode_cost": estimate(40.0)}
    for key, cost in (("cost_hazards", 21.0), ("cost_vases", 22.0)):
        estimates |= {
            f"episode_{key}": estimate(cost), f"cvar_{key}": estimate(cost + 10),
            f"over_limit_{key}": estimate(0.25),
        }  # fmt: skip
    evaluation = {**EVALUATION, "cost_limits": limits, "estimates": estimates}
    (directory / "evaluation.json").write_text(json.dumps(evaluation))
    table = evaluation_table(experiments_in(tmp_path))
    # a row of each cost, so that there may be many; the aggregate cost has no limit
    assert marks(table, "$J_c$") == ["", "bad", ""]
    names = ("cost", "$J_r$", "$J_c$", "$d$", "P($C$ > $d$)", "CVaR")
    value, none = "12.00 [11.00, 13.00]", "—"
    assert [[row[name] for name in names] for row in texts_of(table)] == [
        ["cost", value, "40.0 [39.0, 41.0]", none, none, none],
        ["cost_hazards", value, "21.0 [20.0, 22.0]", "5", "25.0%", "10.0%: 31.0 [30.0, 32.0]"],
        ["cost_vases", value, "22.0 [21.0, 23.0]", "30", "25.0%", "10.0%: 32.0 [31.0, 33.0]"],
    ]


def test_evaluations_are_told_apart_by_their_names(tmp_path):
    # of the mean: training limited something else; of the share: a few of many are not none
    risk = {"_target_": "safe_rl.objectives.CVaR"}
    directory = write_run(tmp_path, columns={"violation_cost": [3.0]}, risk=risk)
    changes = {"episode_cost": estimate(90.0), "over_limit_cost": estimate(0.004)}
    estimates = {**EVALUATION["estimates"], **changes}
    for name in ("", "many"):
        content = {**EVALUATION, "estimates": estimates, "cvar_alpha": 0.005, "name": name}
        Run(directory).evaluation_file(name, "json").write_text(json.dumps(content))
    table = evaluation_table(experiments_in(tmp_path))
    assert marks(table, "$J_c$") == ["", ""]
    for cells, name in zip(texts_of(table), ("", "many, "), strict=True):
        assert cells["what"] == f"{name}mean actions, x=1, 0% known layouts"
        assert cells["P($C$ > $d$)"] == "0.4%"
        assert cells["CVaR"].startswith("0.5%: 70.0")


def test_the_page_holds_everything_itself(report):
    html = (report / "report.html").read_text()
    links = re.findall(r'(?:src|href)="([^"]*)"', html)
    assert all(link.startswith(("data:", "#")) for link in links)
    anchors = [link[1:] for link in links if link.startswith("#")]
    assert anchors
    assert all(f'id="{anchor}"' in html for anchor in anchors)
    assert base64.b64encode((report / "curves.png").read_bytes()).decode() in html
    # what people wrote is text, not markup
    assert "A &lt;title&gt;" in html
    assert "python train.py env=Mine &#39;+note=&lt;b&gt;&amp;&#39;" in html
    assert "it is no run of safe_rl, or has not begun" in html


def test_slates_that_all_share_are_averaged(tmp_path):
    for env in ("PointGoal1", "CarGoal1"):
        for algo in ("ppo", "cpo"):
            write_run(tmp_path, env, algo)
    write_run(tmp_path, "DoggoGoal1", "cpo")
    tables = [slate_table(*slate) for slate in complete_slates(experiments_in(tmp_path), 1)]
    (shared,) = (table for table in tables if table.name == "slate_shared")
    assert shared.title == "What all algorithms were trained on"
    assert "On PointGoal1, CarGoal1." in shared.note


def test_algorithms_formats_and_widths_can_be_chosen(folder, tmp_path):
    words = ["algos=ppo,cpo", "formats=svg,pdf", "width=4", f"out={tmp_path}"]
    assert main([str(folder), *words]) == 0
    page = Page(tmp_path / "report.html")
    assert "PPO-Lagrangian" not in " ".join(page.words)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"curves.png", "curves.svg", "curves.pdf"} <= names
    assert b"/Type3" not in (tmp_path / "curves.pdf").read_bytes()  # publishers refuse these fonts
    curves = pandas.read_csv(tmp_path / "curves.csv")
    cost = curves[(curves.algorithm == "CPO") & (curves.quantity == "cost")]
    assert cost[["steps", "mean"]].to_numpy().tolist() == [[1000.0, 30.0]]


@pytest.mark.parametrize(
    ("argument", "message"),
    [("formats=bmp", "png, svg, pdf"), ("algos=cup", "there are runs of ppo")],
)
def test_what_cannot_be_done_ends_in_one_line(tmp_path, argument, message, capsys):
    write_run(tmp_path)
    assert main([str(tmp_path), argument]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error


def test_where_the_page_cannot_be_is_said_before_any_run_is_read(tmp_path, capsys, monkeypatch):
    write_run(tmp_path)
    (tmp_path / "file").touch()
    monkeypatch.setattr("safe_rl.cli.report.build_report", None)
    assert main([str(tmp_path), f"out={tmp_path / 'file'}"]) == 1
    assert "file is no folder. out=FOLDER writes the report elsewhere." in capsys.readouterr().err
    monkeypatch.setattr("os.access", lambda path, mode: False)  # root may write anywhere
    assert main([str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert f"{tmp_path} is read-only. out=FOLDER writes the report elsewhere." in error


def test_baselines_stand_beside_the_runs_of_the_same_environments_and_are_not_archived(tmp_path):
    mine, other = tmp_path / "mine", tmp_path / "held_out"
    for root in (mine, other):
        write_run(root, algo="cpo", returns=1.0 if root is mine else 5.0)
    write_run(other, algo="ppo")
    write_run(other, env="CarGoal1", algo="ppo")
    out, kept = tmp_path / "out", tmp_path / "kept"
    words = [f"out={out}", f"baselines={other}", f"archive={kept}", "labels={cpo: 'Mine, first'}"]
    assert main([str(mine), *words]) == 0
    table = pandas.read_csv(out / "final_PointGoal1.csv").set_index("algorithm").episode_return
    assert table.to_dict() == {"PPO": 1.0, "Mine, first": 1.0, "Mine, first (held_out)": 5.0}
    assert not (out / "final_CarGoal1.csv").exists()
    for run in other.glob("*/cpo/*/progress.csv"):
        run.unlink()
    others = tmp_path / "others"
    write_run(others, env="CarGoal1", algo="ppo")
    assert main([str(mine), f"out={out}", f"baselines={other},{others}"]) == 0
    told = dict(pandas.read_csv(out / "left_out.csv").to_numpy().tolist())
    assert any("seed0" in place and "no progress.csv" in why for place, why in told.items())
    assert told[str(others)].startswith("no baselines: it has no finished run")
    assert list(read_archive(kept)) == ["PointGoal1/cpo/seed0"]
    assert main([str(mine), *words[:2], "algos=ppo"]) == 0  # only the baselines have it
    assert list(pandas.read_csv(out / "final_PointGoal1.csv").algorithm) == ["PPO"]


def test_algorithms_and_baselines_that_share_a_name_stay_apart(tmp_path):
    write_run(tmp_path / "mine", algo="cpo")
    for place, value in (("x", 10.0), ("y", 30.0)):
        write_run(tmp_path / place / "runs", algo="cpo", returns=value)
        write_run(tmp_path / place / "runs", algo="ppo", seed=1, returns=value + 1)
    places = ",".join(str(tmp_path / place / "runs") for place in "xy")
    words = [f"baselines={places}", f"out={tmp_path}", "labels={cpo: Same, ppo: Same}"]
    assert main([str(tmp_path / "mine"), *words]) == 0
    table = pandas.read_csv(tmp_path / "final_PointGoal1.csv").set_index("algorithm")
    assert table.episode_return.to_dict() == {
        **{"Same (cpo)": 1.0, "Same (cpo) (x/runs)": 10.0, "Same (cpo) (y/runs)": 30.0},
        **{"Same (ppo) (x/runs)": 11.0, "Same (ppo) (y/runs)": 31.0},
    }
