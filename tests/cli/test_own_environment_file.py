"""A configuration file of one's own that holds only what differs, from training to evaluation."""

import pytest
import yaml
from commands import SMALL

from safe_rl.cli import evaluate, train
from safe_rl.envs import SafetyGymConfig, resolve

FILES = {
    "mine": {"name": "mine", "robot_base": "point", "num_steps": 20, "hazards_num": 2},
    "like": {"defaults": ["PointGoal1", "_self_"], "name": "like", "num_steps": 20},
}


@pytest.fixture
def run_with(tmp_path, monkeypatch):
    (tmp_path / "conf" / "env").mkdir(parents=True)
    for name, keys in FILES.items():
        (tmp_path / "conf" / "env" / f"{name}.yaml").write_text(yaml.safe_dump(keys))

    def run(name, *overrides):
        folder = tmp_path / name
        where = (f"hydra.searchpath=[file://{tmp_path / 'conf'}]", f"hydra.run.dir={folder}")
        assert train.main([f"env={name}", *SMALL, *where, *overrides]) == 0
        return folder, yaml.safe_load((folder / "config.yaml").read_text())["env"]

    return run


def test_it_trains_resumes_and_is_evaluated(run_with, capsys):
    folder, env = run_with("mine", "frames=40")
    assert env.keys() == {"name", *SafetyGymConfig().to_dict()}
    assert env["randomize_layout"] is True
    assert env["hazards_num"] == 2
    assert train.main([f"resume={folder}", "frames=80"]) == 0
    assert "Resuming after 40 of 80 frames." in capsys.readouterr().out
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 0
    assert "0% of the layouts known" in capsys.readouterr().out
    assert not (folder / "robot").exists()  # one of the package's needs no copy
    # as a folder from before some keys were there
    config = yaml.safe_load((folder / "config.yaml").read_text())
    (folder / "config.yaml").write_text(yaml.safe_dump(config | {"env": FILES["mine"]}))
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 0


def test_it_can_start_from_one_of_the_suite_and_takes_every_key(run_with):
    _, env = run_with("like", "frames=40", "env.vases_num=3")
    goal = resolve("PointGoal1")
    assert (env["hazards_num"], env["lidar_num_bins"]) == (goal.hazards_num, 16)
    assert (env["name"], env["num_steps"], env["vases_num"]) == ("like", 20, 3)
