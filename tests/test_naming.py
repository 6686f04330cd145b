"""The name that was meant."""

import pytest

from safe_rl.naming import did_you_mean, nearest


@pytest.mark.parametrize(
    ("name", "known", "meant"),
    [
        ("CPO", ["ppo", "cpo"], "cpo"),
        ("TRPO_Lagrangian", ["td3_lagrangian", "trpo_lagrangian"], "trpo_lagrangian"),
        ("ppo-lag", ["ppo", "p3o", "ppo_lagrangian"], "ppo_lagrangian"),
        ("Safexp-CarGoal1-v0", ["CarGoal0", "CarGoal1", "CarGoal2"], "CarGoal1"),
        ("pp", ["ppo", "p3o", "ppo_lagrangian"], "ppo"),
        ("anything", [], None),
    ],
)
def test_the_name_that_was_meant(name, known, meant):
    assert nearest(name, known) == meant
    assert did_you_mean(name, known) == (f" Did you mean '{meant}'?" if meant else "")
