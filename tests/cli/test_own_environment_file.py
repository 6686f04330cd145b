"""A configuration file of one's own that holds only what differs, from training to evaluation."""

import yaml
from commands import SMALL

from safe_rl.cli import evaluate, train
from safe_rl.envs import SafetyGymConfig

MINE = {"name": "mine", "robot_base": "point", "num_steps": 20, "hazards_num": 2}


def test_it_trains_resumes_and_is_evaluated(tmp_path, capsys):
    folder, file = tmp_path / "mine", tmp_path / "conf" / "env" / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(yaml.safe_dump(MINE))
    where = (f"hydra.searchpath=[file://{tmp_path / 'conf'}]", f"hydra.run.dir={folder}")
    assert train.main(["env=mine", *SMALL, *where, "frames=40"]) == 0
    env = yaml.safe_load((folder / "config.yaml").read_text())["env"]
    assert env.keys() == {"name", *SafetyGymConfig().to_dict()}
    assert env["randomize_layout"] is True
    assert env["hazards_num"] == 2
    assert train.main([f"resume={folder}", "frames=80"]) == 0
    assert "Resuming after 40 of 80 frames." in capsys.readouterr().out
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 0
    assert "of the layouts known" not in capsys.readouterr().out
    assert not (folder / "robot").exists()  # one of the package's needs no copy
    # as a folder from before some keys were there
    config = yaml.safe_load((folder / "config.yaml").read_text())
    (folder / "config.yaml").write_text(yaml.safe_dump(config | {"env": MINE}))
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 0
