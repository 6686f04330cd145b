"""Environments of TorchRL, and of users in its interface, through the ordinary commands."""

import json
from types import SimpleNamespace

import pytest
import torch
import torchrl_envs
from commands import run_train
from torchrl.data import Composite, Unbounded
from torchrl.envs import PendulumEnv
from torchrl.envs.utils import check_env_specs

from safe_rl import trust
from safe_rl.cli import evaluate, report
from safe_rl.envs import ConfigError, complete_env, make_env
from safe_rl.envs.torchrl import TORCHRL_CLASSES
from safe_rl.envs.torchrl.step_entries import Observe
from safe_rl.runs.table import read_table
from safe_rl.trust import TargetError

TARGET = "safe_rl.envs.torchrl.make_torchrl"
OUTSIDE = {"cost_speed": ["thdot", -4, 4]}
PENDULUM = {"_target_": TARGET, "id": "PendulumEnv", "num_steps": 30, "outside": OUTSIDE}
RUNNER = {"_target_": TARGET, "id": "torchrl_envs.Runner", "num_steps": 5}
ENDS = RUNNER | {"id": "torchrl_envs.Ends"}
SMALL = (
    *("env=torchrl", "env.id=PendulumEnv", "env.num_steps=20", "num_envs=4"),
    *("frames_per_batch=160", "logger=none", "model.hidden_sizes=[8]", "num_threads=1"),
    *("policy_update.minibatch_size=40", "critic_update.minibatch_size=40"),
)


@pytest.fixture
def trusted(monkeypatch):
    """As after `import=torchrl_envs`."""
    monkeypatch.setitem(trust._ROOMS, "torchrl_envs", None)


def test_it_resumes_is_evaluated_and_reported(tmp_path, capsys):
    folder, trust = tmp_path / "runs" / "pendulum", f"import={torchrl_envs.__file__}"
    costs = ("env.outside={cost_speed: [thdot, -4, 4]}", "env.cost=torchrl_envs:upright")
    limit = "cost_limits={cost_speed: 3}"
    run_train(*SMALL, trust, *costs, limit, "frames=320", f"hydra.run.dir={folder}")
    run_train(trust, f"resume={folder}", "frames=480")
    assert read_table(folder / "progress.csv")["steps"] == [160, 320, 480]
    assert "The state of its environments is not stored" in capsys.readouterr().out
    assert evaluate.main([str(folder), "episodes=4", "num_envs=2"]) == 1
    assert "add that to the command if you trust" in capsys.readouterr().err
    assert evaluate.main([str(folder), "episodes=4", "num_envs=2", trust]) == 0
    facts = json.loads((folder / "evaluation.json").read_text())
    assert facts["environment"] == "PendulumEnv"
    assert facts["estimates"]["episode_length"]["value"] == 20
    assert report.main([str(folder.parent)]) == 0
    assert "PendulumEnv" in (folder.parent / "report" / "runs.csv").read_text()


@pytest.mark.parametrize("name", TORCHRL_CLASSES)
def test_specs_hold_for_every_row(name):
    entry = {"PendulumEnv": "thdot", "FinancialRegimeEnv": "entry_price"}.get(name, "observation")
    node = {"_target_": TARGET, "id": name, "outside": {"cost_far": [entry, -1, 1]}}
    for num_envs in (1, 3):
        env = make_env({**node, "num_steps": 4}, num_envs=num_envs, seed=0)
        check_env_specs(env)
        rollout = env.rollout(9, break_when_any_done=False)
        assert rollout.shape == (num_envs, 9)
        step = rollout["next"]
        torch.testing.assert_close(step["truncated"], step["episode_step"] == 4)
        env.close()


def test_a_step_is_that_of_the_environment():
    env = make_env(PENDULUM, num_envs=3, seed=0)
    start = env.reset()
    start["action"] = torch.tensor([[0.5], [-1.0], [7.0]])
    step = env.step(start.clone())["next"]
    bare = start.select("th", "thdot", "params")
    bare["action"] = torch.tensor([[1.0], [-2.0], [2.0]])  # stretched to its bounds, and cut
    after = PendulumEnv().step(bare)["next"]
    torch.testing.assert_close(step["reward"], after["reward"])
    torch.testing.assert_close(
        step["observation"], torch.stack([after["th"], after["thdot"]], -1), rtol=0, atol=0
    )
    assert env.observation_layout == {"th": slice(0, 1), "thdot": slice(1, 2)}
    assert start["th"].unique().numel() == 3  # rows begin on their own


def test_rows_that_cannot_be_stepped_at_once_are_stepped_apart(trusted):
    env = make_env(PENDULUM | {"id": "torchrl_envs.Alone"}, num_envs=3, seed=0)
    assert env.rollout(2).shape == (3, 2)


def test_rows_end_and_begin_apart():
    env = make_env(PENDULUM | {"num_steps": 8}, num_envs=3, seed=0)
    start = env.reset()
    start["episode_step"] = torch.tensor([[0], [6], [3]])
    keys = {"auto_reset": False, "tensordict": start, "break_when_any_done": False}
    steps = env.rollout(9, lambda td: td.set("action", torch.zeros(3, 1)), **keys)
    ends = steps["next", "done"].squeeze(-1)
    assert [row.nonzero()[0].item() for row in ends] == [7, 1, 4]
    same = [steps[key][:, 1:] == steps["next", key][:, :-1] for key in ("th", "thdot")]
    assert ((same[0] & same[1]) == ~ends[:, :-1]).all()


def test_costs_may_be_entries_ranges_and_functions_at_once(trusted):
    env = make_env(RUNNER | {"outside": {"cost_out": ["place", -9, 1.5]}}, num_envs=3, seed=0)
    assert env.cost_keys == ["cost", "cost_effort", "cost_out"]
    assert "cost_effort" not in env.observation_spec.keys()  # noqa: SIM118
    check_env_specs(env)
    step = env.rollout(5)["next"]
    torch.testing.assert_close(step["cost_effort"], step["reward"] ** 2)
    torch.testing.assert_close(step["cost_out"], (step["observation"] > 1.5).float())
    torch.testing.assert_close(step["cost"], step["cost_effort"] + step["cost_out"])
    assert 0 < step["cost_out"].sum() < 15
    env = make_env(PENDULUM | {"outside": None, "cost": "torchrl_envs:kinds"}, num_envs=4, seed=0)
    assert env.cost_keys == ["cost", "cost_effort", "cost_fast"]
    rollout = env.rollout(30)
    torch.testing.assert_close(rollout["next", "cost_effort"], 2 * rollout["action"].abs())
    cost = {"_target_": "torchrl_envs.upright", "limit": 2.0}
    step = make_env(PENDULUM | {"outside": None, "cost": cost}, num_envs=8, seed=0).rollout(30)
    upright = step["next", "th"].unsqueeze(-1).abs() < 2
    torch.testing.assert_close(step["next", "cost"], upright.float())
    assert 0 < upright.sum() < upright.numel()


def test_several_entries_become_a_vector_or_a_dictionary():
    node = {"_target_": TARGET, "id": "FinancialRegimeEnv", "num_steps": 6}
    node |= {"outside": {"cost_owning": ["current_holdings", 0, 0]}}
    node |= {"observe": ["current_holdings", "price_history"]}
    flat, nested = (make_env(node | {"flatten": f}, num_envs=2, seed=0) for f in (True, False))
    vector, parts = flat.reset()["observation"], nested.reset()["observation"]
    check_env_specs(nested)
    torch.testing.assert_close(vector[:, 1:], parts["price_history"], rtol=0, atol=0)
    assert parts["current_holdings"].shape == (2, 1)
    assert flat.observation_layout == nested.observation_layout
    assert flat.observation_layout["price_history"] == slice(1, 51)
    twins = Composite(a={"x": Unbounded((2, 1))}, b={"x": Unbounded((2, 3))}, shape=(2,))
    env = SimpleNamespace(observation_spec=twins, state_spec=Composite())
    observe = Observe(env, {"observe": ["a.x", "b.x"], "flatten": False})  # alike names stay apart
    assert observe.layout == {"a_x": slice(0, 1), "b_x": slice(1, 4)}
    assert set(observe._call(twins.rand())["observation"].keys()) == {"a_x", "b_x"}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"id": "PendulunEnv"}, "Did you mean 'PendulumEnv'.*import=torchrl.envs"),
        ({"num_steps": None}, "does not say how long"),
        ({"outside": None}, "what does a step cost"),
        ({"outside": {"cost_speed": ["thdto", -4, 4]}}, "Did you mean 'thdot'"),
        ({"outside": {"cost_speed": ["thdot", 1, -4, 4]}}, "no column 1 in thdot. It has 1"),
        ({"observe": ["thdto"]}, "Did you mean 'thdot'"),
        *(({"cost_keys": [key]}, f"'{key}' is a state.*env.outside") for key in ("th", "reward")),
        ({"kwargs": {"mass": 3}}, "env.id=PendulumEnv: TypeError.*mass"),
    ],
)
def test_what_cannot_be_made_is_said(keys, message):
    with pytest.raises(ConfigError, match=message):
        make_env({**PENDULUM, **keys})


@pytest.mark.parametrize("flag", ["done", "terminated"])
def test_an_end_that_one_flag_tells_is_a_termination(flag, trusted):
    env = make_env(ENDS | {"kwargs": {"flag": flag}}, num_envs=2, seed=0)
    steps = env.rollout(6, break_when_any_done=False)["next"]
    for name in ("done", "terminated"):
        assert steps[name][0].flatten().tolist() == [False, True] * 3


def test_rewards_of_integers_can_be_changed_by_transforms(trusted):
    node = {"_target_": "safe_rl.envs.transforms.Saute", "budgets": {"cost": 1.5}}
    node |= {"discount": 1.0, "unsafe_reward": -0.5, "rescale_budgets": False}
    env = make_env(ENDS, num_envs=1, seed=0, transforms={"saute": node})
    check_env_specs(env)
    assert env.rollout(2)["next", "reward"].flatten().tolist() == [1.0, -0.5]


def test_an_environment_may_have_transforms_of_its_own(trusted):
    node = RUNNER | {"id": "torchrl_envs.renamed", "cost_keys": ["cost_effort"]}
    steps = make_env(node, num_envs=2, seed=0).rollout(2)
    assert steps["next", "observation"][0].flatten().tolist() == [1.0, 2.0]


def test_an_entry_that_a_step_leaves_out_is_not_that_of_an_earlier_step(trusted):
    env = make_env(ENDS | {"kwargs": {"silent": True}}, num_envs=2, seed=0)
    with pytest.raises(ConfigError, match=r"Ends: a step wrote no 'cost_effort'.*in every step"):
        env.rollout(2)


def test_only_what_was_imported_is_reached(trusted):
    with pytest.raises(ConfigError, match="one number per row"):
        make_env(PENDULUM | {"cost": "torchrl_envs:wrong"}, num_envs=2)
    with pytest.raises(ConfigError, match="called cost_<kind>, not 'th'"):  # it would replace th
        make_env(PENDULUM | {"cost": {"_target_": "torchrl_envs.wrong", "th": 1}}, num_envs=2)
    with pytest.raises(ConfigError, match="two costs called 'cost_effort': rename one"):
        make_env(RUNNER | {"cost": {"_target_": "torchrl_envs.wrong", "cost_effort": 1}})
    with pytest.raises(TargetError, match=r"env\.cost=os\.getcwd.*import=os"):
        make_env(PENDULUM | {"cost": "os:getcwd"})
    with pytest.raises(TargetError, match=r"env\.id=torchrl\.envs.*import=torchrl\.envs"):
        make_env(PENDULUM | {"id": "torchrl.envs.DMControlEnv"})
    assert complete_env(RUNNER)["cost_keys"] == ["cost_effort"]


@pytest.mark.parametrize("named", [None, ["cost_effort"]])
def test_costs_may_stand_beside_the_reward_already(trusted, named):
    node = RUNNER | {"id": "torchrl_envs.Charged", "cost_keys": named}
    env = make_env(node, num_envs=3, seed=0)
    check_env_specs(env)
    assert env.cost_keys == ["cost", "cost_effort"]
    after = env.rollout(5)["next"]
    assert after["reward"].any()
    assert torch.equal(after["cost_effort"], after["reward"].square())
    assert torch.equal(after["cost"], after["cost_effort"])
