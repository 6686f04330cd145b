"""Somebody else's environment, registered with Gymnasium, through the ordinary commands."""

import json
import math

import gymnasium
import pytest
import torch
from commands import run_train
from gymnasium_envs import Walk  # registers Walk-v0
from torchrl.envs.utils import check_env_specs

from safe_rl.cli import evaluate
from safe_rl.envs import ConfigError, complete_env, make_env

NODE = {
    "_target_": "safe_rl.envs.gymnasium.make_gymnasium",
    "id": "Walk-v0",
    "cost_keys": ["fast", "far"],
}
SMALL = (
    *("env=gymnasium", "env.id=Walk-v0", "env.cost_keys=[fast,far]", "num_envs=4"),
    *("frames_per_batch=200", "logger=none", "model.hidden_sizes=[8]", "num_threads=1"),
    *("policy_update.minibatch_size=50", "critic_update.minibatch_size=50"),
    "cost_limits={fast: 3}",
)


def test_it_is_trained_and_evaluated(tmp_path, capsys):
    run = tmp_path / "walk"
    run_train(*SMALL, "frames=600", "env.kwargs={border: 2.5}", f"hydra.run.dir={run}")
    assert evaluate.main([str(run), "episodes=6", "num_envs=3"]) == 0
    facts = json.loads((run / "evaluation.json").read_text())
    assert facts["environment"] == "Walk-v0"
    assert facts["layouts_trained_on"] == 0.0
    assert evaluate.main([str(run), "env.borders=3"]) == 1
    assert "no key 'borders'" in capsys.readouterr().err


PENDULUM = {"_target_": "safe_rl.envs.torchrl.make_torchrl", "id": "PendulumEnv"}
PENDULUM |= {"num_steps": 9, "outside": {"cost_speed": ["thdot", -4, 4]}}


@pytest.mark.parametrize("node", [NODE, PENDULUM], ids=["gymnasium", "torchrl"])
def test_seeds_determine_rows_and_share_none(node):
    starts = [
        make_env(node, num_envs=4, seed=seed).reset()["observation"][:, 0].tolist()
        for seed in (0, 0, 1, 2)
    ]
    assert starts[0] == starts[1]
    assert len({place for rows in starts for place in rows}) == 12


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"id": None}, r"env\.id="),
        ({"id": "Wolk-v0"}, "Did you mean 'Walk-v0'.*import=my_module"),
        ({"id": "os.path:Walk-v0"}, "import=os.path env.id=Walk-v0"),
        ({"id": "GymV26Environment-v0", "kwargs": {"env_id": "os.path:W-v0"}}, "imports what its"),
        ({"border": 3}, "no key 'border'.*env.kwargs"),
        ({"num_steps": 0}, "num_steps=0: it must be greater"),
        ({"kwargs": {"speed": 3}}, "Walk-v0.*speed"),
        ({"cost_keys": "fast", "num_steps": 5}, "cost_keys=fast: it must be a valid tuple"),
        ({"cost_keys": []}, "what does a step cost"),
        ({"cost_keys": ["fast", "reward"]}, "'reward' is a state.*stays"),
        ({"outside": {"cost_x": [0, 1.0]}}, "got cost_x:"),
        ({"outside": {"cost_x": [0, 1.0, 0.0]}}, "cannot have the range 1.0 to 0.0"),
        ({"outside": {"far": [0, 0.0, 1.0]}}, "called cost or cost_<kind>, not 'far'"),
    ],
)
def test_what_cannot_be_made_is_said(keys, message):
    with pytest.raises(ConfigError, match=message):
        make_env({**NODE, **keys})


def test_observations_may_be_nested():
    nested = {**NODE, "kwargs": {"nested": True}}
    env = make_env(nested, num_envs=2, seed=0)
    flat = make_env({**nested, "flatten": True}, num_envs=2, seed=0).reset()["observation"]
    entries = env.reset()["observation"]
    torch.testing.assert_close(torch.cat([entries["place"], entries["side"]], -1), flat)
    assert env.observation_layout == {"place": slice(0, 2), "side": slice(2, 4)}
    check_env_specs(env)


def test_pictures_are_the_environments_own():
    node = complete_env(NODE)
    with pytest.raises(ValueError, match="render_mode=rgb_array"):
        make_env(node, seed=0).render(rows=0)
    env = make_env({**node, "render_mode": "rgb_array"}, num_envs=2, seed=0)
    place = env.reset()["observation"][1, 0].item()
    picture = env.render(rows=1)
    assert picture.shape == (20, 60, 3)
    assert picture.max(axis=(0, 2)).nonzero()[0].tolist() == [int(30 + 9 * place)]
    assert env.render().shape == (2, 20, 60, 3)
    assert env.render(rows=torch.tensor(1)).shape == (20, 60, 3)
    assert env.render(rows=torch.tensor([1])).shape == (1, 20, 60, 3)


def test_registered_arguments_and_limits_are_kept():
    made = []
    walk = lambda **keys: made.append(keys) or Walk(**keys)  # noqa: E731
    gymnasium.register("ShortWalk-v0", walk, max_episode_steps=3, kwargs={"border": 99.0})
    env = make_env({**NODE, "id": "ShortWalk-v0"}, num_envs=2, seed=0)
    assert len(made) == 1 + 2  # one more, for what the node does not say
    rollout = env.rollout(10)
    assert rollout.shape == (2, 3)
    assert rollout["next", "truncated"][:, -1].all()
    assert make_env({**NODE, "num_steps": 2}, seed=0).rollout(10).shape == (1, 2)


@pytest.mark.parametrize(
    ("outside", "reported", "bounds"),
    [
        ({"cost_a": [1, -0.3, 0.3]}, None, [1.0, 1.0]),
        ({"cost_a": [0, -0.04, 0.03], "cost_b": [2, -0.1, math.inf]}, None, [2.0, 1.0, 1.0]),
        ({"cost_a": [1, -0.3, 0.3]}, ["cost_told"], None),
    ],
)
def test_costs_of_ranges_are_bounded_in_the_spec_and_stand_beside_others(outside, reported, bounds):
    node = {**NODE, "id": "CartPole-v1", "num_steps": 200, "outside": outside}
    env = make_env(node | {"cost_keys": reported}, num_envs=3, seed=0)
    rollout = env.rollout(200, break_when_any_done=False)
    assert rollout["action"].dtype == torch.int64
    step = rollout["next"]
    for key, (column, low, high) in outside.items():
        place = step["observation"][..., [column]]
        expected = ((place < low) | (place > high)).float()
        assert 0 < expected.mean() < 1
        torch.testing.assert_close(step[key], expected)
    torch.testing.assert_close(step["cost"], sum(step[key] for key in outside))
    assert env.cost_keys == ["cost", *(reported or []), *outside]
    if bounds:
        assert [env.full_reward_spec[k].high.max().item() for k in env.cost_keys] == bounds
        check_env_specs(env)
