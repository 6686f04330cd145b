"""Policies as small folders, those of the package, and policies as ONNX."""

import json
import shlex
import shutil

import numpy as np
import pytest
import torch

import safe_rl
from safe_rl.cli.evaluate import main as evaluate
from safe_rl.cli.export import main as export
from safe_rl.evaluation import policies
from safe_rl.evaluation.episodes import exploration

QUICK = ("episodes=2", "num_envs=2", "num_threads=1")


@pytest.fixture
def package(monkeypatch, tmp_path):
    """A package with a policy for PointGoal1, of a run that is not here any more."""
    monkeypatch.setattr(policies, "POLICIES", tmp_path / "package")
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "package"


def test_a_policy_of_the_package_is_loaded_and_evaluated_as_a_run(run, package, capsys):
    observation = safe_rl.load(run).env.reset()
    with exploration(deterministic=True):
        expected = safe_rl.load(run).policy(observation.clone())["action"]
    assert export([str(run), str(package / "PointGoal1")]) == 0
    shutil.rmtree(run)
    loaded = safe_rl.load("certified/PointGoal1")
    with exploration(deterministic=True):
        assert torch.equal(loaded.policy(observation)["action"], expected)
    files = {path.relative_to(package) for path in package.rglob("*")}
    assert evaluate(["certified/PointGoal1", *QUICK]) == 0
    assert "at 320 steps: 2 episodes" in capsys.readouterr().out
    # what is written lies in the working directory
    assert (package.parent / "work/certified/PointGoal1/evaluation.json").is_file()
    assert {path.relative_to(package) for path in package.rglob("*")} == files
    assert evaluate(["certified/PointGaol1", *QUICK]) == 1
    assert "Did you mean 'PointGoal1'?" in capsys.readouterr().err


def test_a_packed_policy_is_small_and_says_where_it_is_from(run, tmp_path):
    (run / ".hydra").mkdir()
    (run / ".hydra/overrides.yaml").write_text("- model.hidden_sizes=[16, 16]\n- '+note=it''s'\n")
    assert export([str(run), str(tmp_path / "packed")]) == 0
    about = json.loads((tmp_path / "packed" / "policy.json").read_text())
    expected = {"environment": "PointGoal1", "algorithm": "ppo_lagrangian", "steps": 320}
    assert about.items() >= expected.items()
    assert shlex.split(about["command"])[2:] == ["model.hidden_sizes=[16, 16]", "+note=it's"]
    whole = sum(path.stat().st_size for path in (run / "checkpoints/last").iterdir())
    packed = sum(path.stat().st_size for path in (tmp_path / "packed").rglob("*.torchrl"))
    assert packed < whole / 2


def test_only_a_certified_policy_is_packed_as_certified(run, tmp_path):
    (run / "certificate.json").write_text('{"certified": true}')
    packed = tmp_path / "packed"
    for kind, which in (("last", ()), ("certified", ()), ("last", ("checkpoint=last",))):
        assert export([str(run), str(packed), *which]) == 0
        assert [path.name for path in (packed / "checkpoints").iterdir()] == [kind]
        assert (packed / "certificate.json").is_file() == (kind == "certified")
        shutil.copytree(run / "checkpoints/last", run / "checkpoints/certified", dirs_exist_ok=True)


@pytest.mark.parametrize("path", sorted(policies.POLICIES.glob("*/certificate.json")), ids=str)
def test_policies_of_the_package_are_certified_and_small(path):
    assert json.loads(path.read_text())["certified"]
    assert len(json.loads((path.parent / "policy.json").read_text())["commit"]) == 40
    assert sum(file.stat().st_size for file in path.parent.rglob("*")) < 150_000


def test_an_exported_policy_is_the_policy(run, tmp_path):
    runtime = pytest.importorskip("onnxruntime")
    assert export([str(run), str(tmp_path / "policy.onnx"), "checkpoint=last"]) == 0
    loaded = safe_rl.load(run)
    env = loaded.make_env(num_envs=5)
    session = runtime.InferenceSession(tmp_path / "policy.onnx")
    state = env.reset()
    for _ in range(3):
        with exploration(deterministic=True):
            state = loaded.policy(state)
        (action,) = session.run(["action"], {"observation": state["observation"].numpy()})
        low, high = env.action_spec.space.low, env.action_spec.space.high
        expected = state["action"].clamp(low, high).numpy()
        np.testing.assert_allclose(action, expected, atol=1e-5)
        state = env.step(state)["next"]


def test_what_cannot_be_exported_is_said_in_a_line(run, tmp_path, capsys):
    assert export([str(run)]) == 2
    assert export([str(run), str(tmp_path / "a.onx")]) == 1
    assert "FILE.onnx, or a FOLDER" in capsys.readouterr().err
    assert export([str(run), str(tmp_path / "a.onnx"), "checkpoint=certified"]) == 1
    assert not (tmp_path / "a.onnx").exists()
    for folder in (run, tmp_path):  # whose files are not those of an exported policy
        assert export([str(run), str(folder)]) == 1
        assert f"error: {folder} has other files" in capsys.readouterr().err
    assert safe_rl.load(run).policy
