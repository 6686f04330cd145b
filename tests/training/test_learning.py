"""Learning on the benchmark itself, against bounds that a broken loss or environment misses."""

import pytest

import safe_rl


@pytest.mark.slow
def test_ppo_lagrangian_keeps_its_limit_and_still_reaches_goals(tmp_path, monkeypatch):
    """Four seeds came to returns of 10 to 13 and costs of 18 to 27 with a smaller margin."""
    monkeypatch.chdir(tmp_path)
    run = safe_rl.train("PointGoal1", algo="ppo_lagrangian", frames=1_000_000, logger="none")
    assert run.final["episode_return"] > 6
    assert run.final["episode_cost"] < 30
