"""Policies as small folders, those of the package, and policies as ONNX."""

import json
import re
import shlex
import shutil
from unittest.mock import Mock

import gymnasium
import gymnasium_envs  # noqa: F401, registers Tank-v0
import numpy as np
import pytest
import torch
from commands import ROOT
from torchrl.data import Unbounded
from torchrl.envs import GymWrapper
from torchrl.envs.libs.gym import default_info_dict_reader

import safe_rl
from safe_rl.cli.evaluate import main as evaluate
from safe_rl.cli.export import main as export
from safe_rl.evaluation import EvaluationOptions, policies
from safe_rl.evaluation import evaluate as measure
from safe_rl.evaluation.episodes import exploration
from safe_rl.scores.bounds import rounded_up

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
    mine = package.parent / "work/certified/PointGoal1"
    assert (mine / "evaluation.json").is_file()
    (mine / "certificate.json").write_text("mine")  # the copy is not copied over
    measure(str(package / "PointGoal1"), EvaluationOptions(episodes=2, num_envs=2))
    assert (mine / "certificate.json").read_text() == "mine"
    (mine / "certificate.json").unlink()
    assert {path.relative_to(package) for path in package.rglob("*")} == files
    assert evaluate(["certified/PointGaol1", *QUICK]) == 1
    assert "Did you mean 'PointGoal1'?" in capsys.readouterr().err


def test_a_packed_policy_is_small_and_says_where_it_is_from(run, tmp_path):
    (run / ".hydra/overrides.yaml").write_text(
        "- model.hidden_sizes=[16, 16]\n- '+note=it''s'\n- import=['my_gym.py']\n"
    )
    sources = [{"path": "/home/me/conf", "provider": "command-line"}]
    runtime = {"cwd": "/home/me", "config_sources": sources}
    (run / ".hydra/hydra.yaml").write_text(json.dumps({"hydra": {"runtime": runtime}}))
    assert export([str(run), str(tmp_path / "packed")]) == 0
    about = json.loads((tmp_path / "packed" / "policy.json").read_text())
    expected = {"environment": "PointGoal1", "algorithm": "ppo_lagrangian", "steps": 320}
    assert about.items() >= expected.items()
    # as it was typed; Hydra notes a list of imports
    expected = ["--config-dir=conf", "model.hidden_sizes=[16, 16]", "+note=it's"]
    assert shlex.split(about["command"])[2:] == [*expected, "import=my_gym.py"]
    whole = sum(path.stat().st_size for path in (run / "checkpoints/last").iterdir())
    packed = sum(path.stat().st_size for path in (tmp_path / "packed").rglob("*.torchrl"))
    assert packed < whole / 2


def test_an_option_of_an_export_is_checked(run, tmp_path, capsys):
    assert export([str(run), str(tmp_path / "packed"), "actions=meen"]) == 1
    assert "actions=meen: it must be 'mean' or 'sampled'" in capsys.readouterr().err
    assert export([str(run), str(tmp_path / "packed"), "actions=mean"]) == 1
    assert "actions: it is that of FILE.onnx" in capsys.readouterr().err
    assert not (tmp_path / "packed").exists()


def test_only_a_certified_policy_is_packed_as_certified(run, tmp_path):
    name = next((run / "checkpoints/last").iterdir()).name
    (run / "certificate.json").write_text(json.dumps({"certified": True, "checkpoint": name}))
    packed = tmp_path / "packed"
    for kind, which in (("last", ()), ("certified", ()), ("last", ("checkpoint=last",))):
        assert export([str(run), str(packed), *which]) == 0
        assert [path.name for path in (packed / "checkpoints").iterdir()] == [kind]
        assert (packed / "certificate.json").is_file() == (kind == "certified")
        shutil.copytree(run / "checkpoints/last", run / "checkpoints/certified", dirs_exist_ok=True)


def test_an_export_that_was_killed_can_be_repeated(run, tmp_path, monkeypatch):
    packed = tmp_path / "packed"
    with monkeypatch.context() as patch:
        patch.setattr(policies, "save_tensors", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            policies.pack_policy(run, packed, "last")
    (packed / ".policy.0123456789abcdef.json").touch()  # of one that was killed still earlier
    assert policies.pack_policy(run, packed, "last").is_file()
    (packed / "evaluation.json").write_text("{}")  # of the policy that was there before
    policies.pack_policy(run, packed, "last")
    assert not (packed / "evaluation.json").exists()


@pytest.mark.parametrize("path", sorted(policies.POLICIES.glob("*/certificate.json")), ids=str)
def test_policies_of_the_package_are_certified_and_small_and_as_their_page_says(path):
    certificate, about = (
        json.loads((path.parent / name).read_text()) for name in ("certificate.json", "policy.json")
    )
    assert certificate["certified"]
    assert len(about["commit"]) == 40
    bound = rounded_up(certificate["bounds"]["mean_cost"]["bound"])
    row = f"| {about['steps']:,} | ≤ {bound:.1f} | {certificate['episode_return']:.1f} |"
    lines = PAGE.read_text().splitlines()
    (line,) = (line for line in lines if line.startswith(f"| `certified/{path.parent.name}` |"))
    assert f"{row} {certificate['episodes']:,} |" in line
    assert sum(file.stat().st_size for file in path.parent.rglob("*")) < 150_000


def exported(run, file, *options):
    runtime = pytest.importorskip("onnxruntime")
    assert export([str(run), str(file), *options]) == 0
    return runtime.InferenceSession(file)


def texts_of(session):
    """What an exported policy says of itself."""
    found = session.get_modelmeta().custom_metadata_map
    return {name: json.loads(text) for name, text in found.items()}


def test_an_exported_policy_is_the_policy(run, tmp_path):
    session = exported(run, tmp_path / "policy.onnx", "checkpoint=last")
    loaded = safe_rl.load(run)
    env = loaded.make_env(num_envs=5)
    state = env.reset()
    for _ in range(3):
        with exploration(deterministic=True):
            state = loaded.policy(state)
        (action,) = session.run(["action"], {"observation": state["observation"].numpy()})
        low, high = env.action_spec.space.low, env.action_spec.space.high
        expected = state["action"].clamp(low, high).numpy()
        np.testing.assert_allclose(action, expected, atol=1e-5)
        state = env.step(state)["next"]


def tank_of_torchrl():
    """An environment of Gymnasium's for TorchRL, with the cost beside the reward."""
    reader = default_info_dict_reader(["cost"], [Unbounded((1,))])
    return GymWrapper(gymnasium.make("Tank-v0")).set_info_dict_reader(reader)


PAGE = ROOT / "docs" / "policies.md"
FAMILIES = {
    "SafeHumanoidVelocity": (
        {"env.num_steps": 8}, "SafeHumanoidVelocity-v0", {"config": {"num_steps": 8}}
    ),
    "gymnasium": ({"env.id": "Tank-v0"}, "Tank-v0", {}),
    "torchrl": (
        {"env.id": f"{__name__}.tank_of_torchrl", "env.num_steps": 20, "imports": [__name__]},
        "Tank-v0", {},
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("family", "algo"),
    [*((family, "ppo_lagrangian") for family in FAMILIES), ("gymnasium", "sac_lagrangian")],
)
def test_an_exported_policy_acts_in_the_environment_itself(family, algo, tmp_path):
    settings, env_id, keys = FAMILIES[family]
    small = {"frames": 80, "num_envs": 2, "frames_per_batch": 40, "logger": "none"}
    run = safe_rl.train(family, algo=algo, directory=tmp_path / "run", **small, **settings)
    words = [f"import={name}" for name in settings.get("imports", ())]
    session = exported(run.directory, tmp_path / "policy.onnx", *words)
    code = re.search(r"<!-- file: run_onnx.py -->\n```python\n(.*?)```", PAGE.read_text(), re.S)
    program: dict = {}
    exec(code[1], program)
    policy = program["OnnxPolicy"](tmp_path / "policy.onnx")
    env = gymnasium.make(env_id, **keys)
    found = program["run_episode"](env, policy, seed=7)
    given = {"episodes": 1, "num_envs": 1, "num_threads": 1, "seed": 7, "deterministic": True}
    expected = run.evaluate(**given).estimates
    named = [expected[name].value for name in ("episode_return", "episode_cost")]
    np.testing.assert_allclose(found, named, rtol=1e-2, atol=1e-2)
    assert policy.about["action_low"] == env.action_space.low.tolist()
    assert policy.about["action_high"] == env.action_space.high.tolist()
    assert len(policy.about["observation"]) == session.get_inputs()[0].shape[1]
    assert policy.about["environment"]["name"] == run.config.env.name


def test_an_exported_policy_says_which_transforms_its_program_needs(tmp_path, capsys):
    small = {"frames": 40, "num_envs": 2, "frames_per_batch": 40, "logger": "none"}
    small |= {"env.id": "Tank-v0", "env.outside": {"cost_full": [0, 0, 1]}}
    run = safe_rl.train(
        "gymnasium", directory=tmp_path / "run", transforms=["observed_costs"], **small
    )
    certified(run.directory, True)
    session = exported(run.directory, tmp_path / "policy.onnx")
    assert "without the transforms observed_costs:" in capsys.readouterr().out
    texts = texts_of(session)
    assert texts["certificate"]["transforms"] == ["observed_costs"]
    assert "deterministic" not in texts["certificate"]  # which older ones lack: `actions` says it
    # the names of the costs that a program has to observe, in their order
    steps, names, columns = run.env.rollout(20)["next"], texts["costs"], texts["observation"]
    seen = [columns.index(f"last_costs[{number}]") for number in range(len(names))]
    expected = torch.cat([steps[name] for name in names], -1)
    assert torch.equal(steps["observation"][..., seen], expected)
    assert (expected.sum(1) > 0).any()


def certified(run, deterministic):
    shutil.copytree(run / "checkpoints/last", run / "checkpoints/certified", dirs_exist_ok=True)
    content = {"certified": True, "deterministic": deterministic, "level": 0.95, "bounds": {}}
    content["checkpoint"] = next((run / "checkpoints/last").iterdir()).name
    (run / "certificate.json").write_text(json.dumps(content))


@pytest.mark.parametrize("deterministic", [False, True])
def test_what_is_certified_is_what_is_exported(run, tmp_path, capsys, deterministic):
    certified(run, deterministic)
    file = tmp_path / "new" / "folder" / "policy.onnx"
    zeros = {"observation": np.zeros((2, 60), np.float32)}
    session = exported(run, file)
    texts, kinds = texts_of(session), {True: "mean", False: "sampled"}
    assert texts["actions"] == kinds[deterministic]
    assert texts["certificate"]["level"] == 0.95
    # the rows see the same: they act alike unless actions are sampled
    (actions,) = session.run(["action"], zeros)
    assert np.array_equal(*actions) == deterministic
    assert "WARNING" not in capsys.readouterr().err
    other = exported(run, file, f"actions={kinds[not deterministic]}")
    assert "which the certificate does not cover" in capsys.readouterr().err
    texts = texts_of(other)
    assert (texts["actions"], texts["certificate"]) == (kinds[not deterministic], None)


def test_the_samples_of_a_plain_actor_are_exported_too(run, tmp_path, monkeypatch):
    """An algorithm of one's own may have one as its policy."""
    monkeypatch.setattr("safe_rl.algorithms.on_policy.make_behaviour", lambda actor: actor)
    session = exported(run, tmp_path / "policy.onnx", "checkpoint=last", "actions=sampled")
    (actions,) = session.run(["action"], {"observation": np.zeros((2, 60), np.float32)})
    assert not np.array_equal(*actions)


def test_what_cannot_be_exported_is_said_in_a_line(run, tmp_path, capsys):
    assert export([str(run)]) == 2
    assert export([str(run), str(tmp_path / "a.onx")]) == 1
    assert "FILE.onnx, or a FOLDER" in capsys.readouterr().err
    assert export([str(run), str(tmp_path / "b" / "a.onnx"), "checkpoint=certified"]) == 1
    assert not (tmp_path / "b").exists()
    for folder in (run, tmp_path):  # whose files are not those of an exported policy
        assert export([str(run), str(folder)]) == 1
        assert f"error: {folder} has other files" in capsys.readouterr().err
    assert safe_rl.load(run).policy
