"""Values that a run cannot have are named before it begins, in one line."""

import subprocess
import sys
from pathlib import Path

import pytest
from run_configs import point_mass_config

from safe_rl.cli.schema import SettingError, check_settings

ROOT = Path(__file__).parents[2]
WRONG = {
    "frames=abc": "frames=abc: it must be a whole number from 1 to .* \\(steps to train for\\)",
    "frames=0": "frames=0",
    "frames=1.5": r"frames=1\.5",
    "num_envs=0": "num_envs=0",
    "seed=-1": "seed=-1: it must be a whole number from 0",
    "seed=true": "seed=true",
    "checkpoint.interval=abc": r"checkpoint\.interval=abc: it must be a number from 0.*seconds",
    "checkpoint.keep_last=0": r"checkpoint\.keep_last=0",
    "num_threads=0": "num_threads=0",
    "model.hidden_sizes=64": r"model\.hidden_sizes=64: it must be a list",
    "device=gpu": "device=gpu: it must be cpu, cuda or",
    "cost_limits=25": r"cost_limits=25: it must be a mapping",
}


@pytest.mark.parametrize("override", WRONG)
def test_wrong_values_are_named(override):
    with pytest.raises(SettingError, match=WRONG[override]):
        check_settings(point_mass_config(override))


@pytest.mark.parametrize("override", ["frames=3e5", "num_threads=null", "checkpoint.interval=0"])
def test_right_values_pass(override):
    check_settings(point_mass_config(override))


@pytest.mark.slow
def test_train_py_ends_in_a_line_where_no_world_can_be_made(tmp_path):
    command = [sys.executable, "train.py", "env.hazards_num=200", f"hydra.run.dir={tmp_path}/run"]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 1
    assert "attempts: most often 'hazard" in result.stderr
    assert "('hazards_num' is 200)" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "run").exists()
