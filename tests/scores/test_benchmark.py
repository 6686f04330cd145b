"""Only what is exactly the benchmark's is measured by the benchmark's scores."""

import pytest

from safe_rl.cli.report import suite
from safe_rl.scores.benchmark import REFERENCE

SUITE = suite()
NODE = SUITE.environments["PointGoal1"]


@pytest.mark.parametrize("name", REFERENCE)
def test_every_environment_with_scores_is_itself(name):
    assert SUITE.reference(SUITE.environments[name]) == REFERENCE[name]


@pytest.mark.parametrize(
    "node",
    [
        {**NODE, "name": "PointGoal2"},
        {**NODE, "name": "Mine"},
        {**NODE, "name": ["PointGoal1"]},
        {key: value for key, value in NODE.items() if key != "name"},
        {**NODE, "hazards_num": 3},
        {**NODE, "hazards_num": "${oc.env:NUMBER}"},
        {**NODE, "_target_": "some.other.family"},
        {**NODE, "id": "Pendulum-v1"},
        {"name": "PointGoal1"},
        {"name": "PointGoal1", "id": "Pendulum-v1", "cost_keys": ["cost"]},
        {"name": "PointGoal1", "robot_base": "point", "task": "goal"},
    ],
)
def test_another_environment_under_its_name_is_not_it(node):
    assert SUITE.name_of(node) is None
    assert SUITE.reference(node) is None


def test_keys_at_their_defaults_may_be_left_out():
    changed = {k: v for k, v in NODE.items() if k == "name" or SUITE.defaults.get(k) != v}
    assert len(changed) < len(NODE) / 2
    assert SUITE.name_of(changed) == "PointGoal1"


def test_changes_are_named_and_may_be_allowed():
    node = {**NODE, "layout_seeds": 10, "hazards_size": 0.3}
    assert SUITE.changes(node) == {"layout_seeds": 10, "hazards_size": 0.3}
    assert SUITE.changes({**NODE, "name": "Mine"}) is None
    assert SUITE.name_of({**NODE, "layout_seeds": 10}) is None
    assert SUITE.name_of({**NODE, "layout_seeds": 10}, but_for=["layout_seeds"]) == "PointGoal1"
