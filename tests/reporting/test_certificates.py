"""Certificates of runs in the report: who has one, and the bounds that speak for and against."""

import csv
import json

from synthetic import write_run

from safe_rl.cli.report import main


def certify(root, algo, **changes):
    """A run with a certificate, which says this if nothing else is given."""
    content = {
        "certified": True,
        "checkpoint": "checkpoint-000000002000.torchrl",
        "episode_return": 1.5,
        "bounds": {"mean_cost": {"bound": 19.7252, "most": 25.0}},
        "episodes": 400,
        "level": 0.95,
        **changes,
    }
    (write_run(root, algo=algo) / "certificate.json").write_text(json.dumps(content))


def report(root):
    """Rows of the table of certificates by algorithm."""
    assert main([str(root)]) == 0
    with (root / "report" / "certificates.csv").open() as file:
        return {row["algorithm"]: row for row in csv.DictReader(file)}


def test_a_certificate_and_a_missing_one_have_a_row_each(tmp_path):
    certify(tmp_path, "cpo", level=0.9995)
    none = {"certified": False, "checkpoint": None, "episode_return": None}
    certify(tmp_path, "p3o", **none, bounds={"mean_cost": {"bound": 31.6512, "most": 25.0}})
    write_run(tmp_path, algo="ppo")  # has none, and is not spoken of
    rows = report(tmp_path)
    tex = (tmp_path / "report" / "tables.tex").read_text().replace(r" \\", "")
    first = r"CPO & 0 & yes at 99.95\% & 2,000 steps & 1.50 & mean\_cost & 19.73 & 25 & 400"
    assert f"{first} & Student, sampled actions" in tex
    assert r"no at 95\% $\triangle$ & -- & -- & mean\_cost & 31.66 & 25 & 400" in tex
    bounds = {name: row["bound_mean_cost"] for name, row in rows.items()}
    assert bounds == {"CPO": "19.7252", "P3O": "31.6512"}


def test_rows_say_what_holds_by_construction_and_which_bound_was_used(tmp_path):
    certify(tmp_path, "betting", bound="betting", highest={"cost": 1000.0}, deterministic=True)
    certify(tmp_path, "ended", bound="betting", highest={"mean_cost": 25.0})
    certify(tmp_path, "older")
    rows = report(tmp_path).items()
    assert {name: (row["certified"], row["test"], row["actions"]) for name, row in rows} == {
        "betting": ("yes", "betting", "mean"),
        "ended": ("by construction", "betting", "sampled"),
        "older": ("yes", "Student", "sampled"),
    }
    assert "too low if rare episodes" in (tmp_path / "report" / "report.html").read_text()
