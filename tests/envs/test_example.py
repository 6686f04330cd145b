"""The example of an environment of one's own does what it says, by the ordinary commands."""

import runpy
from types import SimpleNamespace

import pytest
from commands import ROOT, SMALL, in_a_process, status_of

from safe_rl.cli.evaluate import main as evaluate
from safe_rl.envs import SafetyGymEnv
from safe_rl.runs.table import read_table

pytestmark = pytest.mark.long

PATH = ROOT / "examples" / "custom_environment.py"
IMPORT = f"import={PATH.relative_to(ROOT)}"
MINES = ("env=PointMines", "cost_limits={cost_mines: 10}", "env.mines_num=8")


@pytest.fixture
def example(registrations_undone):
    return SimpleNamespace(**runpy.run_path(str(PATH)))


def test_it_is_trained_resumed_and_evaluated_by_the_ordinary_commands(
    tmp_path, monkeypatch, registrations_undone
):
    # with a worker, which has to import it too
    worker = ("collector=process", "collector.num_collectors=1")
    begun = (*MINES, *SMALL, "frames=80", f"hydra.run.dir={tmp_path}")
    in_a_process("train.py", IMPORT, *begun, *worker)
    assert "estimate_cost_mines" in read_table(tmp_path / "progress.csv")
    monkeypatch.chdir(ROOT)
    resume = (f"resume={tmp_path}", "frames=160")
    assert f"was trained with {IMPORT}: add that to the command" in str(status_of(*resume))
    assert status_of(*resume, IMPORT) == 0
    assert evaluate([str(tmp_path), "episodes=2", IMPORT]) == 0
    assert read_table(tmp_path / "progress.csv")["steps"] == [40, 80, 120, 160]
    assert "cost_mines" in (tmp_path / "evaluation.json").read_text()


def test_robots_meet_its_mines(example):
    env = SafetyGymEnv(example.POINT_MINES, num_envs=50, seed=0, num_threads=1)
    assert {"mines_lidar", "speed"} <= env.observation_layout.keys()
    rollout = env.rollout(200)
    assert 0 < float((rollout["next", "cost_mines"] > 0).float().mean()) < 0.5
    assert float(rollout["next", "cost_mines"].max()) <= 1.0
