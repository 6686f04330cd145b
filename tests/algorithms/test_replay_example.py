"""The script with TorchRL's own collector and buffer runs, and its critics learn."""

import importlib.util
from pathlib import Path

PATH = Path(__file__).parents[2] / "examples" / "replay_buffer.py"


def test_the_losses_fit_torchrls_collector_and_buffer(capsys):
    spec = importlib.util.spec_from_file_location("replay_buffer", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sizes = ["--num-envs=4", "--frames=12000", "--frames-per-batch=4000", "--updates-per-batch=20"]
    rows = module.main(["--limit=1", *sizes])
    assert len(rows) == 3
    assert [row["episodes"] for row in rows] == [4, 4, 4]
    # episodes at random cost more than 1
    assert rows[0]["episode_cost"] > 1
    assert rows[-1]["multiplier"] > 0
    assert rows[-1]["loss_qvalue"] < rows[0]["loss_qvalue"]
    assert capsys.readouterr().out.count("J_r") == 3
