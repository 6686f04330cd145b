"""One function says which name was meant, and nothing else in the package looks for one."""

from pathlib import Path

import pytest

from safe_rl.naming import did_you_mean, nearest

PACKAGE = Path(__file__).parents[1] / "safe_rl"


@pytest.mark.parametrize(
    ("name", "known", "meant"),
    [
        ("hazard_num", ["vases_num", "hazards_num"], "hazards_num"),
        ("cop", ["ppo", "cpo"], "cpo"),
        ("CPO", ["ppo", "cpo"], "cpo"),
        ("TRPO_Lagrangian", ["td3_lagrangian", "trpo_lagrangian"], "trpo_lagrangian"),
        ("ppo-lag", ["ppo", "p3o", "ppo_lagrangian"], "ppo_lagrangian"),
        ("Safexp-CarGoal1-v0", ["CarGoal0", "CarGoal1", "CarGoal2"], "CarGoal1"),
        ("pp", ["ppo", "p3o", "ppo_lagrangian"], "ppo"),
        ("zzz", ["hazards_num"], None),
        ("anything", [], None),
    ],
)
def test_the_name_that_was_meant(name, known, meant):
    assert nearest(name, known) == meant
    assert did_you_mean(name, known) == (f" Did you mean '{meant}'?" if meant else "")


def test_nothing_else_looks_for_names():
    copies = [path for path in PACKAGE.rglob("*.py") if "difflib" in path.read_text()]
    assert copies == [PACKAGE / "naming.py"]
