"""What a certificate says, in words and in its file."""

import json
import math
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from safe_rl.evaluation import Certificate, CertificateOptions
from safe_rl.evaluation.certifying import _write
from safe_rl.reporting.tables import read_certificate
from safe_rl.runs.run import Run
from safe_rl.scores.certificate import Verdict

OPTIONS = CertificateOptions(ranking=6, episodes=120, tests=2, level=0.95, most_over=1.0)
CHECKPOINT = Path("checkpoint-000000000100.torchrl")


@pytest.mark.parametrize(("level", "shown"), [(0.995, "99.5%"), (0.95, "95%"), (0.999, "99.9%")])
def test_levels_are_not_rounded(level, shown):
    verdict = Verdict(None, [0])
    certificate = Certificate(None, math.nan, verdict, replace(OPTIONS, level=level))
    assert f"at {shown} with sampled actions: " in str(certificate)


def test_the_bounds_that_miss_their_limits_are_shown_with_the_limits():
    bounds = {"mean_cost": (10.82, 5.0), "mean_fast": (1.0, 2.0)}
    verdict = Verdict(None, [0], bounds, {"mean_cost": 5.82}, [], {}, 20)
    certificate = Certificate(None, math.nan, verdict, OPTIONS)
    assert str(certificate).endswith("(mean_cost ≤ 10.9, limit 5; 20 new episodes).")
    assert certificate.may_need_training
    above = replace(verdict, bounds={"mean_cost": (math.inf, 5.0)}, shortfalls={"mean_cost": 5})
    said = str(replace(certificate, verdict=above))
    assert "mean_cost has no bound: costs are NaN, or above those that the specs" in said
    assert not replace(certificate, verdict=above).may_need_training


def test_several_bounds_are_a_table_and_what_holds_by_construction_is_said():
    bounds = {"mean_cost": (24.1, 25.0), "mean_fast": (2.0, 2.0)}
    verdict = Verdict(0, [0], bounds, {}, ["mean_fast"], {"cost": 1000.0, "fast": 2.0}, 700)
    means = {"mean_cost": 20.0, "mean_fast": 1.5}
    head, *rows, last = str(Certificate(CHECKPOINT, 3.0, verdict, OPTIONS, means, 100)).split("\n")
    assert head.startswith("Certified at 95% with sampled actions, all bounds together (700 new")
    assert rows == [
        "  mean_cost ≤ 24.1, limit 25, mean 20",
        "  mean_fast ≤ 2 by construction, limit 2, mean 1.5",
    ]
    assert last.startswith("The bound includes rare")
    alone = replace(verdict, bounds={"mean_fast": (2.0, 2.0)})
    said = str(Certificate(CHECKPOINT, 3.0, alone, OPTIONS, {"mean_fast": 1.5}, 100))
    assert said.startswith("Limit kept with sampled actions: mean_fast ≤ 2 by construction, ")
    assert "ertified" not in said


def test_costs_without_a_highest_are_said_to_count_up_to_a_cap_and_written_as_json(tmp_path):
    bounds = {"beyond_250_cost": (0.008, 0.01), "mean_cost": (math.inf, 25.0)}
    verdict = Verdict(0, [0], bounds, {}, [], {"cost": math.inf}, 700)
    certificate = Certificate(CHECKPOINT, 1.0, verdict, OPTIONS)
    text = str(certificate)
    assert "The mean of cost is that of costs up to 250; beyond_250_cost is the share" in text

    refuse = Mock(side_effect=AssertionError)  # NaN and infinities are no JSON
    _write(Run(tmp_path), replace(certificate, checkpoint=None), [100])
    content = json.loads((tmp_path / "certificate.json").read_text(), parse_constant=refuse)
    assert content["bounds"]["mean_cost"] == {"bound": None, "most": 25.0}
    assert (content["episodes"], content["most_episodes"]) == (700, 120)
    assert read_certificate(content)["most_mean_cost"] == 25.0
