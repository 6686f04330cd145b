"""Robots and environment files of one's own: runs find them again, whatever is in them."""

import contextlib
import json
import shutil

import pytest
import yaml
from commands import SMALL, status_of
from run_configs import without_times

import safe_rl
from safe_rl.cli import evaluate, export
from safe_rl.envs import SafetyGymConfig

ROBOT = """
<mujoco>
  <compiler meshdir="{meshes}"/>
  <worldbody>
    <body name="robot" pos="0 0 0.12">
      <freejoint/>
      <geom type="sphere" size="0.12" density="{density}"/>
      <site name="imu"/>
      <include file="parts/hat.xml"/>
    </body>
  </worldbody>
  <asset><mesh name="hat" file="hat.obj"/></asset>
  <actuator><general site="imu" gear="1 0 0 0 0 0.01"/></actuator>
  <sensor><gyro name="gyro" site="imu"/></sensor>
</mujoco>
"""
HAT = '<mujoco><geom type="mesh" mesh="hat" pos="0 0 0.2" contype="0" conaffinity="0"/></mujoco>'
TETRAHEDRON = """
v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1
f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4
"""


def write_robot(folder, meshes="meshes", density=1):
    for name in ("robot/parts", "robot/meshes", "meshes"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    path = folder / "robot" / "ball.xml"
    path.write_text(ROBOT.format(meshes=meshes, density=density))
    (folder / "robot" / "parts" / "hat.xml").write_text(HAT)
    for place in (folder / "meshes", folder / "robot" / "meshes"):
        (place / "hat.obj").write_text(TETRAHEDRON)
    return path


def begin(place, name="run", frames=40, **robot):
    """A run on a robot file that the command line names from the folder it is in."""
    write_robot(place, **robot)
    folder = place / name
    robot = ("env.robot_base=robot/ball.xml", "env.sensors_obs=[gyro]")
    assert status_of(*SMALL, *robot, f"hydra.run.dir={folder}", f"frames={frames}") == 0
    return folder


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    with contextlib.chdir(place := tmp_path_factory.mktemp("begun")):
        return begin(place)


@pytest.fixture
def run(begun, tmp_path, monkeypatch):
    """Makes such a run, or a copy of the one that there is, where the command line then is."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)

    def run(*name, **keys):
        if name or keys:
            return begin(tmp_path, *name, **keys)
        write_robot(tmp_path)
        return shutil.copytree(begun, tmp_path / "run")

    return run


def test_a_changed_robot_changes_neither_the_run_nor_its_evaluation_nor_its_policy(run, tmp_path):
    whole, folder, policy, rows = run("whole", frames=80), run(), tmp_path / "policy", []
    assert export.main([str(folder), str(policy)]) == 0
    for place in (folder, folder, policy):
        assert evaluate.main([str(place), "episodes=2", "num_threads=1"]) == 0
        rows.append((place / "evaluation.csv").read_text())
        write_robot(tmp_path, density=30)
    assert rows[0] == rows[1] == rows[2]
    assert status_of(f"resume={folder}", "frames=80") == 0
    assert without_times(folder / "progress.csv") == without_times(whole / "progress.csv")
    # the name of the robot, by which runs are told apart, stays
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["env"]["robot_base"] == "robot/ball.xml"


def test_a_robot_in_the_place_of_its_copy_is_kept(run, tmp_path):
    with pytest.raises(AssertionError, match=r"would replace .*robot: give it another folder"):
        run(".")
    assert (tmp_path / "robot" / "ball.xml").is_file()


def test_a_run_is_carried_elsewhere(run, tmp_path, monkeypatch, capsys):
    (elsewhere := tmp_path / "elsewhere").mkdir()
    run().rename(elsewhere / "run")
    monkeypatch.chdir(elsewhere)
    assert status_of("resume=run", "frames=80") == 0
    assert safe_rl.load("run").env.rollout(3).shape == (1, 3)
    assert evaluate.main(["run", "episodes=2", "num_threads=1", "env.robot_base=point"]) == 1
    assert "trained on other observations or actions" in capsys.readouterr().err


def test_another_robot_than_the_runs_is_never_taken(run, tmp_path, capsys):
    folder = run()
    note = json.loads((folder / "robot.json").read_text())
    with (folder / "robot" / "meshes" / "hat.obj").open("a") as file:
        file.write("# more")
    write_robot(tmp_path, density=30)
    for kept in (note["file"], None, "../../robot/ball.xml"):
        (folder / "robot.json").write_text(json.dumps(note | {"file": kept}))
        assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 1
        assert "has changed since the run began" in capsys.readouterr().err
    assert "has changed since the run began" in status_of(f"resume={folder}", "frames=80")


@pytest.mark.parametrize("place", ["../meshes", "{}/meshes", "linked"])
def test_what_lies_outside_of_its_folder_is_not_copied(place, run, tmp_path, capsys):
    """A robot of somebody else's could copy a secret into a run that is then published."""
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "linked").symlink_to(tmp_path / "meshes")
    meshes = place.format(tmp_path)
    folder = run(meshes=meshes)
    said = capsys.readouterr().out
    assert f"{tmp_path}/meshes/hat.obj, which is outside its own folder" in said
    assert "The run keeps no copy of its robot" in said
    assert not (folder / "robot").exists()
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 0
    write_robot(tmp_path, meshes=meshes, density=30)
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 1
    assert "has changed since the run began" in capsys.readouterr().err


def test_only_what_mujoco_loads_is_copied(run, tmp_path):
    """Names were looked for in every folder of assets, where a secret of that name could lie."""
    (tmp_path / "robot" / "textures").mkdir(parents=True)
    (tmp_path / "robot" / "textures" / "hat.obj").write_text("secret")
    folder = run(meshes='meshes" texturedir="textures')
    copied = {str(path.relative_to(folder)) for path in folder.glob("robot/**/*.*")}
    assert copied == {"robot/ball.xml", "robot/meshes/hat.obj", "robot/parts/hat.xml"}


def test_a_run_keeps_every_key_of_an_environment_file_that_holds_only_what_differs(
    tmp_path, capsys
):
    mine = {"name": "mine", "robot_base": "point", "num_steps": 20, "hazards_num": 2}
    folder, file = tmp_path / "mine", tmp_path / "conf" / "env" / "mine.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(yaml.safe_dump(mine))
    where = (f"hydra.searchpath=[file://{tmp_path / 'conf'}]", f"hydra.run.dir={folder}")
    assert status_of("env=mine", *SMALL, *where, "frames=40") == 0
    config = yaml.safe_load((folder / "config.yaml").read_text())
    assert config["env"].keys() == {"name", *SafetyGymConfig().to_dict()}
    assert config["env"]["randomize_layout"] is True
    assert config["env"]["hazards_num"] == 2
    assert status_of(f"resume={folder}", "frames=80") == 0
    assert "Resuming after 40 of 80 frames." in capsys.readouterr().out
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 0
    assert "of the layouts known" not in capsys.readouterr().out
    assert not (folder / "robot").exists()  # one of the package's needs no copy
    # as a folder from before some keys were there
    (folder / "config.yaml").write_text(yaml.safe_dump(config | {"env": mine}))
    assert evaluate.main([str(folder), "episodes=2", "num_threads=1"]) == 0
