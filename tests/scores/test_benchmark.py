"""Only what is exactly the benchmark's is measured by its scores; tables agree with each other."""

import numpy as np
import pytest

from safe_rl.cli.report import suite
from safe_rl.envs import SUITE, resolve
from safe_rl.scores.benchmark import (
    ALGORITHMS,
    PUBLISHED,
    REFERENCE,
    REIMPLEMENTATIONS,
    SLATES,
    Scores,
    normalise,
)

BENCHMARK = suite()
NODE = BENCHMARK.environments["PointGoal1"]


def test_the_slates_are_made_of_the_suites_constrained_environments():
    constrained = {
        name
        for name in SUITE
        if any(value is True for key, value in resolve(name).to_dict().items() if _constrains(key))
    }
    assert set(SLATES["SG18"]) == constrained
    assert {name: len(members) for name, members in SLATES.items()} == {
        "SG1": 9, "SG2": 9, "SG6": 6, "SG12": 12, "SG18": 18,
        "SGPoint": 6, "SGCar": 6, "SGDoggo": 6,
    }  # fmt: skip
    for name, robot in (("SGPoint", "point"), ("SGCar", "car"), ("SGDoggo", "doggo")):
        assert {resolve(member).robot_base for member in SLATES[name]} == {robot}
    parts = [set(SLATES[name]) for name in ("SG1", "SG2")]
    assert parts[0] | parts[1] == constrained
    assert not parts[0] & parts[1]
    # at least one of each task, robot and level
    assert {resolve(name).task for name in SLATES["SG6"]} == {"goal", "button", "push"}
    assert {resolve(name).robot_base for name in SLATES["SG6"]} == {"point", "car", "doggo"}


def _constrains(key):
    return key.startswith("constrain_") and key != "constrain_indicator"


@pytest.mark.parametrize("parts", [("SG1", "SG2"), ("SGPoint", "SGCar", "SGDoggo")])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_published_averages_of_parts_give_the_average_of_all(algorithm, parts):
    average = np.mean([PUBLISHED[part][algorithm] for part in parts], axis=0)
    np.testing.assert_allclose(PUBLISHED["SG18"][algorithm], average, atol=1.01e-3)


def test_every_table_has_every_algorithm():
    assert all(list(table) == list(ALGORITHMS) for table in PUBLISHED.values())
    assert all(list(table) == list(ALGORITHMS) for table in REIMPLEMENTATIONS.values())
    assert set(REIMPLEMENTATIONS) <= set(REFERENCE)
    assert all(value > 0 for scores in REFERENCE.values() for value in scores)


def test_normalisation_by_hand():
    reference = Scores(20.0, 75.0, 0.08)
    # nothing for what stays below the limit; the excess over the limit, not over the reference
    costs = [0.0, 25.0, 30.0, 125.0]
    found = normalise([-10.0, 30.0], costs, 0.02, limit=25.0, reference=reference)
    expected = ([-0.5, 1.5], [0, 0, 0.1, 2.0], 0.25)
    for values, known in zip(found, expected, strict=True):
        np.testing.assert_allclose(values, known)
    # a reference within the limit divides by epsilon
    below = normalise(1.0, [26.0, 25.0], 1.0, limit=25.0, reference=Scores(20.0, 10.0, 0.01))[1]
    np.testing.assert_allclose(below, [1e6, 0.0])


@pytest.mark.parametrize(
    "node",
    [
        {**NODE, "name": "PointGoal2"},
        {**NODE, "name": "Mine"},
        {**NODE, "name": ["PointGoal1"]},
        {key: value for key, value in NODE.items() if key != "name"},
        {**NODE, "hazards_num": 3},
        {**NODE, "_target_": "some.other.family"},
        {**NODE, "id": "Pendulum-v1"},
        {"name": "PointGoal1"},
        {"name": "PointGoal1", "id": "Pendulum-v1", "cost_keys": ["cost"]},
        {"name": "PointGoal1", "robot_base": "point", "task": "goal"},
    ],
)
def test_another_environment_under_its_name_is_not_it(node):
    assert BENCHMARK.name_of(node) is None


def test_keys_at_their_defaults_may_be_left_out():
    changed = {k: v for k, v in NODE.items() if k == "name" or BENCHMARK.defaults.get(k) != v}
    assert len(changed) < len(NODE) / 2
    assert BENCHMARK.name_of(changed) == "PointGoal1"
