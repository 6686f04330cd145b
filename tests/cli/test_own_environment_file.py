"""A configuration file of one's own that holds only what differs, from training to evaluation."""

import re

import pytest
import yaml

from safe_rl.cli import evaluate, train
from safe_rl.envs import SUITE, SafetyGymConfig

SMALL = (
    *("num_envs=2", "frames_per_batch=40", "logger=none", "model.hidden_sizes=[8]"),
    *("policy_update.minibatch_size=20", "critic_update.minibatch_size=20", "num_threads=1"),
)
FILES = {
    "mine": {"name": "mine", "robot_base": "point", "num_steps": 20, "hazards_num": 2},
    "wrong": {"name": "wrong", "robot_base": "point", "hazard_num": 2},
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


def test_a_folder_from_before_that_lacks_keys_is_evaluated(run_with):
    folder, _ = run_with("mine", "frames=40")
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["env"] = FILES["mine"]
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 0


def test_it_can_start_from_one_of_the_suite_and_takes_every_key(run_with):
    _, env = run_with("like", "frames=40", "env.vases_num=3")
    goal = SUITE["PointGoal1"]
    assert (env["hazards_num"], env["lidar_num_bins"]) == (goal.hazards_num, 16)
    assert (env["name"], env["num_steps"], env["vases_num"]) == ("like", 20, 3)


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("like", "env.task=gaol", "'task' must be one of"),
        ("wrong", "frames=40", "Unknown configuration key 'hazard_num'"),
    ],
)
def test_wrong_keys_and_values_end_in_a_line(run_with, capsys, name, override, message):
    with pytest.raises(AssertionError, match=re.escape(message)):
        run_with(name, override)
