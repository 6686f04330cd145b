"""The script with TorchRL's own collector and buffer runs, with multipliers that episodes move."""

import math

import pytest
import replay_buffer


def test_the_losses_fit_torchrls_collector_and_buffer(capsys):
    sizes = ["--num-envs=4", "--frames=12000", "--frames-per-batch=4000", "--updates-per-batch=20"]
    rows = replay_buffer.main(["--limit=0", *sizes])
    assert len(rows) == 3
    assert [row["episodes"] for row in rows] == [4, 4, 4]
    assert rows[0]["multiplier"] == pytest.approx(0.15 * min(rows[0]["episode_cost"], 0.5))
    assert all(math.isfinite(row["loss_qvalue"]) for row in rows)
    assert capsys.readouterr().out.count("J_r") == 3
