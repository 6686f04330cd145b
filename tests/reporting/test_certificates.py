"""Certificates of runs in the report: who has one, and the bounds that speak for and against."""

import csv
import json

import pytest
from synthetic import write_run

from safe_rl.cli.report import main

EPOCHS = {"returns": (1.0, 2.0), "costs": (30.0, 20.0), "rates": (0.03, 0.025)}


def certificate(**changes):
    return {
        "certified": True,
        "checkpoint": "checkpoint-000000002000.torchrl",
        "episode_return": 1.5,
        "bounds": {"mean_cost": {"bound": 19.7252, "most": 25.0}},
        "episodes": 400,
        "level": 0.95,
        **changes,
    }


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path, algo="cpo", **EPOCHS)


def test_a_certificate_and_a_missing_one_have_a_row_each(run, tmp_path):
    (run / "certificate.json").write_text(json.dumps(certificate(level=0.9995)))
    other = write_run(tmp_path, algo="p3o", **EPOCHS)
    none = certificate(
        certified=False, checkpoint=None, episode_return=None,
        bounds={"mean_cost": {"bound": 31.6512, "most": 25.0}},
    )  # fmt: skip
    (other / "certificate.json").write_text(json.dumps(none))
    write_run(tmp_path, algo="ppo", **EPOCHS)  # has none, and is not spoken of
    assert main([str(tmp_path)]) == 0
    tex = (tmp_path / "report" / "tables.tex").read_text().replace(r" \\", "")
    first = r"CPO & 0 & yes at 99.95\% & 2,000 steps & 1.50 & mean\_cost & 19.73 & 25 & 400"
    assert f"{first} & Student, sampled actions" in tex
    assert r"no at 95\% $\triangle$ & -- & -- & mean\_cost & 31.66 & 25 & 400" in tex
    with (tmp_path / "report" / "certificates.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["algorithm"]: row["bound_mean_cost"] for row in rows} == {
        "CPO": "19.7252",
        next(row["algorithm"] for row in rows if row["algorithm"] != "CPO"): "31.6512",
    }


def test_rows_say_what_holds_by_construction_and_which_bound_was_used(tmp_path):
    given = {
        "betting": certificate(bound="betting", highest={"cost": 1000.0}, deterministic=True),
        "ended": certificate(bound="betting", highest={"mean_cost": 25.0}),
        "older": certificate(),
    }
    for algo, content in given.items():
        run = write_run(tmp_path, algo=algo, **EPOCHS)
        (run / "certificate.json").write_text(json.dumps(content))
    assert main([str(tmp_path)]) == 0
    with (tmp_path / "report" / "certificates.csv").open() as file:
        rows = {row["algorithm"]: row for row in csv.DictReader(file)}
    assert {
        name: (row["certified"], row["test"], row["actions"]) for name, row in rows.items()
    } == {
        "betting": ("yes", "betting", "mean"),
        "ended": ("by construction", "betting", "sampled"),
        "older": ("yes", "Student", "sampled"),
    }
    assert "too low if rare episodes" in (tmp_path / "report" / "report.html").read_text()
