"""Parts of one's own: the example of a risk measure, losses, and networks of a function.

Also which environments the networks of off-policy algorithms are for.
"""

import math

import custom_risk
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium_envs import Walk
from omegaconf import OmegaConf
from point_mass import PointMass
from point_mass_runs import point_mass_trainer, trainer_of
from run_configs import CONF, off_policy_config
from torchrl.data import Bounded, Unbounded

from safe_rl import trust
from safe_rl.algorithms import Constraints, OffPolicy
from safe_rl.checks import SettingError
from safe_rl.envs import from_gymnasium
from safe_rl.evaluation.settings import certificate_options
from safe_rl.models import QEnsemble, make_actor, make_critic, make_squashed_actor
from safe_rl.objectives import PPOLoss
from safe_rl.runs.run import Run
from safe_rl.runs.table import read_table
from safe_rl.training.train import certify_finished
from safe_rl.trust import TargetError, allow

EXAMPLES = CONF.parent / "examples"
allow("custom_risk")
allow(__name__)


def test_measured_costs_sum_to_mean_and_semideviation():
    costs = torch.rand(6, 10, 1)
    ends = torch.zeros(6, 10, dtype=torch.bool)
    ends[:, -1] = True
    totals = costs.sum(1)
    risk = custom_risk.UpperSemideviation(torch.tensor([1.0]), weight=0.5, decay=0.0)
    measured = risk(costs, ends, torch.zeros(6, 1), totals).costs.sum(1)
    expected = totals.mean() + 0.5 * (totals - totals.mean()).clamp_min(0).mean()
    torch.testing.assert_close(measured.mean(), expected)


def test_it_trains_with_several_costs(tmp_path):
    trainer = point_mass_trainer(
        tmp_path, f"hydra.searchpath=[file://{EXAMPLES / 'conf'}]", "algo=p3o",
        "risk=semideviation", "cost_limits={cost_hazards: 1, cost_north: 0.5}",
    )  # fmt: skip
    trainer.run()
    table = read_table(tmp_path / "progress.csv")
    for key, limit in (("cost_hazards", 1), ("cost_north", 0.5)):
        expected = [estimate - limit for estimate in table[f"estimate_{key}"]]
        assert table[f"violation_{key}"] == pytest.approx(expected, abs=1e-5)
    run, said = Run(tmp_path), []
    certify_finished(run, run.config, 25, stopped_by=None, again=str, say=said.append)
    assert said[0].startswith("Not certified: there is no test for limits on UpperSemideviation.")
    own = OmegaConf.merge(run.config, {"risk": {"tail": 0.2}})
    assert certificate_options(own).tail == 1.0


class ReadsCosts(PPOLoss):
    extra_in_keys = (("next", "cost"),)

    def _surrogates(self, tensordict, log_weight):
        assert tensordict["next", "cost"].shape == tensordict["advantage"].shape
        return super()._surrogates(tensordict, log_weight)


def test_a_loss_gets_the_entries_that_it_names(tmp_path):
    trainer = point_mass_trainer(tmp_path, "algo=ppo", f"loss._target_={__name__}.ReadsCosts")
    assert trainer.epoch(iter(trainer.collector))["policy_num_steps"] > 0


@pytest.mark.parametrize("name", ["A2CLoss", "ClipPPOLoss"])
def test_a_run_learns_with_a_loss_of_torchrls(name, tmp_path, monkeypatch):
    """What is not one number for each of its constraints is logged as a scalar."""
    monkeypatch.setitem(trust._ROOMS, "torchrl.objectives", None)
    keys = ("algo=ppo", f"loss._target_=torchrl.objectives.{name}")
    with pytest.raises(SettingError, match="this one reports none: use max_kl=null and adapt"):
        point_mass_trainer(tmp_path / "kl", *keys).run()
    free = ("policy_update.max_kl=null", "policy_update.adapt_rate=null")
    trainer = point_mass_trainer(tmp_path, *keys, *free)
    row = trainer.epoch(iter(trainer.collector))
    assert math.isfinite(row["policy_loss_critic"])
    assert ("policy_explained_variance" in row) == (name != "A2CLoss")


def test_what_is_neither_a_number_nor_one_for_each_constraint_is_named():
    with pytest.raises(ValueError, match=r"'policy_own' has the shape \[3\].*each of 2"):
        Constraints({"cost_a": 1.0, "cost_b": 1.0}).column("policy_own", torch.zeros(3))


TARGET = f"+model._target_={__name__}"


def assert_all_learn(trainer):
    """A run moves every parameter of its networks."""
    networks = trainer.algorithm.networks
    before = {name: [p.clone() for p in net.parameters()] for name, net in networks.items()}
    trainer.run()
    for name, network in networks.items():
        pairs = zip(before[name], network.parameters(), strict=True)
        assert not any(torch.equal(old, new) for old, new in pairs), name


def tall(hidden_sizes, initial_log_std, observation_spec, num_costs, *, layers=1, **others):
    size = observation_spec["observation"].shape[-1]
    widths = [*hidden_sizes] * layers
    networks = {
        "actor": make_actor(size, 2, hidden_sizes=hidden_sizes, initial_log_std=initial_log_std),
        "critic": make_critic(size, hidden_sizes=widths),
    }
    if num_costs:
        networks["cost_critic"] = make_critic(
            size, hidden_sizes=widths, out_key="cost_value", num_outputs=num_costs
        )
    return networks


def without_costs(observation_spec, **given):
    return tall(observation_spec=observation_spec, num_costs=0, **given)


def test_a_run_trains_the_networks_of_a_function(tmp_path):
    own = ["algo=cpo", f"{TARGET}.tall", "+model.layers=3", "frames=320"]
    own += ["cost_limits={cost: 1, cost_north: 2}"]
    trainer = point_mass_trainer(tmp_path, *own, minibatch_size=None)
    networks = trainer.algorithm.networks
    assert set(networks) == {"actor", "critic", "cost_critic"}
    shapes = [tuple(p.shape) for p in networks["critic"].parameters() if p.ndim == 2]
    assert shapes[1:] == [(16, 16), (16, 16), (1, 16)]
    assert_all_learn(trainer)


def test_a_missing_network_is_named(tmp_path):
    with pytest.raises(TargetError, match=r"without_costs must return .*; it lacks cost_critic\."):
        point_mass_trainer(tmp_path, "algo=cpo", f"{TARGET}.without_costs", minibatch_size=None)


def with_three(hidden_sizes, observation_spec, action_spec, cost_outputs, **others):
    size, low, high = observation_spec["observation"].shape[-1], action_spec.low, action_spec.high
    critics = {"hidden_sizes": hidden_sizes, "num_networks": 3}
    costs = {"num_outputs": cost_outputs, "out_key": "cost_state_action_value"}
    return {
        "actor": make_squashed_actor(size, low, high, hidden_sizes=hidden_sizes),
        "critic": QEnsemble(size, len(low), **critics),
        "cost_critic": QEnsemble(size, len(low), **critics, **costs),
    }


def test_an_off_policy_run_trains_the_networks_of_a_function(tmp_path):
    config = off_policy_config("algo=sac_lagrangian", f"{TARGET}.with_three", "frames=480")
    trainer = trainer_of(config, tmp_path)
    assert trainer.algorithm.networks["cost_critic"].num_networks == 3
    assert_all_learn(trainer)


class Acting(PointMass):
    def __init__(self, action_spec):
        super().__init__(action_spec.shape[0])
        self.action_spec = action_spec


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (Unbounded((2, 2)), r"actions within bounds.*Unbounded"),
        (Bounded(-1, 1, (2, 2, 3)), r"the shape \[2, 3\]: policies act by vectors"),
    ],
)
def test_other_actions_than_vectors_within_bounds_are_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        OffPolicy.from_config(off_policy_config("algo=sac"), Acting(spec))


class Seen(Walk):
    """A bright column of a picture is where the point is; its speed is a number beside it."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gymnasium.spaces.Dict(
        picture=gymnasium.spaces.Box(0, 255, (36, 36, 3), np.uint8),
        speed=gymnasium.spaces.Box(-9.0, 9.0, (1,), np.float32),
    )

    def _observe(self):
        picture = np.zeros((36, 36, 3), np.uint8)
        picture[:, int(18 + 8 * self.place)] = 255
        return {"picture": picture, "speed": np.array([self.speed], np.float32)}

    def step(self, action):
        self.speed = float(action[0])
        self.place = np.clip(self.place + 0.2 * self.speed, -2, 2)
        return self._observe(), self.speed, False, False, {"cost": float(self.place > 0)}


@pytest.mark.parametrize(
    "algo",
    [
        "sac_lagrangian",
        *(pytest.param(a, marks=pytest.mark.long) for a in ("td3_lagrangian", "wcsac")),
    ],
)
def test_pictures_and_numbers_beside_them_are_learned_from(algo, tmp_path):
    env = from_gymnasium(Seen, num_envs=4, num_steps=20, flatten=False, seed=0)
    steps = ("memory.n_steps=3", "memory.capacity=1000")
    config = off_policy_config(f"algo={algo}", "model=cnn", "frames=480", *steps)
    trainer = trainer_of(config, tmp_path, env)
    for name, network in trainer.algorithm.networks.items():
        assert sum("encoder" in key for key, _ in network.named_parameters()) == 6, name
    assert_all_learn(trainer)


def test_pictures_are_stored_with_those_three_steps_later():
    env = from_gymnasium(Seen, num_envs=2, num_steps=20, flatten=False, seed=0)
    config = off_policy_config("algo=sac", "model=cnn", "memory.n_steps=3", "memory.capacity=1000")
    memory = OffPolicy.from_config(config, env).replay_buffer
    steps = env.rollout(8, policy=lambda step: step.set("action", torch.ones(2, 1)))
    memory.extend(steps)
    batch = next(iter(memory.minibatches(1)))
    here, after = batch["observation", "picture"], batch["next", "observation", "picture"]
    assert here.dtype == torch.uint8
    first, then = (picture[:, 0, :, 0].int().argmax(1) for picture in (here, after))
    # by 1.6 columns in each step
    assert set((then - first)[first < 28].tolist()) <= {4, 5}


@pytest.mark.parametrize("algo", ["sac_lagrangian", "td3_lagrangian"])
def test_bounds_of_double_precision_are_for_networks_of_single_precision(algo, tmp_path):
    env = Acting(Bounded(-1, 1, (4, 2), dtype=torch.float64))
    trainer = trainer_of(off_policy_config(f"algo={algo}", "frames=480"), tmp_path, env)
    trainer.run()
    assert read_table(tmp_path / "progress.csv")["policy_num_updates"] == [8, 8, 8]
    assert trainer.algorithm.policy(env.reset())["action"].dtype == torch.float32
