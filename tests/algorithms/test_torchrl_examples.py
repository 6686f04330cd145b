"""TorchRL's trainers, collector and replay buffer with our parts: the examples, and the parts."""

import math

import pytest
import replay_buffer
import torch
import torchrl_trainer as example
from point_mass import PointMass
from run_configs import compose_config
from samples import make_actor, make_batch, make_critic, perturb

from safe_rl.algorithms.algorithm_contract import find_algorithm
from safe_rl.collectors import EpisodeAccounting
from safe_rl.objectives import (
    ActorCriticLoss,
    CostGAE,
    CriticLoss,
    JointAdvantages,
    LagrangeMultiplier,
    LimitState,
    PPOLagrangianLoss,
    VectorGAE,
)

LIMITS = {"cost_hazards": 1.0, "cost_north": 0.5}
SETTINGS = {"gamma": 0.99, "lmbda": 0.97, "value_target": "lambda_return"}


def weights(module):
    return [parameter.detach().clone() for parameter in module.parameters()]


def test_ppo_lagrangian_in_torchrls_ppo_trainer():
    env = PointMass(num_envs=4, num_steps=20)
    trainer = example.ppo_lagrangian_trainer(env, LIMITS, frames=480, frames_per_batch=160)
    loss, before = trainer.loss_module, weights(trainer.loss_module)
    trainer.train()
    assert all(not torch.equal(a, b) for a, b in zip(before, weights(loss), strict=True))
    history = trainer._log_dict
    assert [len(history[key]) for key in ("episode_return", "optim_steps")] == [3, 3]
    # 3 batches, 4 passes, 5 minibatches
    assert history["optim_steps"][-1] >= 60
    twin = LagrangeMultiplier(LIMITS, init=1.0, lr=0.05)
    for index in range(3):
        costs = [history[f"episode_{key}"][index] for key in LIMITS]
        twin.update(LimitState.of(cost=costs, limit=list(LIMITS.values())))
        for key, value in zip(LIMITS, twin.value.tolist(), strict=True):
            assert history[f"multiplier_{key}"][index] == pytest.approx(value, rel=1e-5)
            violation = history[f"episode_{key}"][index] - LIMITS[key]
            assert history[f"violation_{key}"][index] == pytest.approx(violation, abs=1e-5)
    torch.testing.assert_close(loss.policy_loss.multiplier.value, twin.value)


def test_cpo_steps_in_torchrls_trainer():
    env = PointMass(num_envs=4, num_steps=20)
    trainer = example.cpo_trainer(env, LIMITS, frames=480, frames_per_batch=160)
    actor, critics = trainer.loss_module.actor_network, trainer.loss_module.critic_loss
    before = weights(actor), weights(critics)
    trainer.train()
    history = trainer._log_dict
    assert len(history["kl"]) == 3
    assert all(0 <= kl <= 0.01 for kl in history["kl"])
    assert any(fraction > 0 for fraction in history["step_fraction"])
    for key in LIMITS:
        # the violation of the very batch, per step, is what the step went by
        violations = torch.tensor(history[f"violation_{key}"])
        torch.testing.assert_close(torch.tensor(history[f"c_{key}"]), violations / 20)
    for old, module in zip(before, (actor, critics), strict=True):
        assert any(not torch.equal(a, b) for a, b in zip(old, weights(module), strict=True))
    # what collects is what was trained
    collecting = dict(trainer.collector.policy.named_parameters())
    trained = [p for name, p in collecting.items() if "module" in name]
    assert all(map(torch.equal, trained, weights(actor)))


def make_pair(critic_coeff=0.5):
    actor = make_actor()
    batch = make_batch(actor, [16], 2)
    batch["value_target"], batch["cost_value_target"] = torch.randn(16, 1), torch.randn(16, 2)
    perturb(actor)
    multiplier = LagrangeMultiplier([1.0, 1.0], init=[0.5, 2.0], lr=0.05)
    policy = PPOLagrangianLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.01)
    critics = CriticLoss(make_critic(), make_critic("cost_value", 2))
    return ActorCriticLoss(policy, critics, critic_coeff=critic_coeff), policy, critics, batch


def test_the_composite_loss_is_its_parts():
    loss, policy, critics, batch = make_pair(critic_coeff=0.5)
    losses, expected, fitted = loss(batch), policy(batch), critics(batch)
    assert set(losses.keys()) == set(loss.out_keys)
    for key, value in expected.items():
        assert torch.equal(losses[key], value)
    for key, value in fitted.items():
        weight = 0.5 if key.startswith("loss_") else 1.0
        torch.testing.assert_close(losses[key], weight * value)
    assert len(list(loss.parameters())) == len([*policy.parameters(), *critics.parameters()])
    assert {p.data_ptr() for p in loss.actor_network.parameters()} == {
        p.data_ptr() for p in policy.parameters()
    }
    values = loss(**{key: batch[key] for key in loss.in_keys})
    torch.testing.assert_close(values[0], losses["loss_objective"])


def test_keys_reach_the_part_that_reads_them():
    loss, policy, critics, _ = make_pair()
    loss.set_keys(reward="r", done="d", terminated="t", action="a", value_target="v")
    assert policy.tensor_keys.action == "a"
    assert critics.tensor_keys.value_target == "v"
    assert {"a", "v"} <= set(loss.in_keys)
    with pytest.raises(ValueError, match="no key 'advantages'"):
        loss.set_keys(advantages="a")
    cost = CostGAE(["cost"], None, **SETTINGS)
    estimator = JointAdvantages(VectorGAE(None, **SETTINGS), cost)
    estimator.set_keys(reward="r", done="d", terminated="t")
    assert ("next", "r") in estimator.in_keys
    assert cost.reward_keys == ["cost"]
    assert (cost.tensor_keys.done, cost.tensor_keys.terminated) == ("d", "t")


def test_the_command_of_the_example(capsys, monkeypatch):
    monkeypatch.setattr(
        example, "make_env", lambda name, num_envs, seed: PointMass(num_envs, 20, seed)
    )
    trainer = example.main(["--frames=160", "--frames-per-batch=80", "--num-envs=4"])
    assert trainer.collected_frames == 160
    assert capsys.readouterr().out.count("J_r") == 2


def test_a_mask_and_a_reduction_are_those_of_both_parts():
    loss, policy, critics, batch = make_pair(critic_coeff=1.0)
    batch["kept"] = torch.arange(16) < 9
    expected = {**policy(batch[:9]), **critics(batch[:9])}
    loss.loss_mask_key = "kept"
    for key, value in loss(batch).items():
        torch.testing.assert_close(value, expected[key], msg=key)
    loss.loss_mask_key, loss.reduction = None, "none"
    assert loss(batch)["loss_objective"].shape == loss(batch)["loss_critic"].shape == (16,)


SIZES = ["--num-envs=4", "--frames=240", "--frames-per-batch=80", "--updates-per-batch=20"]
# numbers of the script, and no gradient steps
SAME = (
    "env=PointMass", "algo=sac_lagrangian", "limits=null", "lagrangian=replay",
    "lagrangian.init=0", "lagrangian.kp=0.1", "lagrangian.ki=0.05", "lagrangian.saturation=0.5",
    "lagrangian.highest=5", "cost_limits={cost: 1}", "policy_update.updates_per_step=1e-9",
)  # fmt: skip


def test_lambda_has_the_scale_that_it_has_in_the_package(monkeypatch, capsys):
    config = compose_config(*SAME)
    algorithm = find_algorithm(config).from_config(config, PointMass(4, 20))
    expected, losses = [], []

    class Both(EpisodeAccounting):
        def update(self, batch):
            episodes = super().update(batch)
            row = algorithm.learn(batch.clone(), episodes)
            expected.append((row["multiplier_cost"], algorithm.policy_update.loss))
            return episodes

    def make_loss(*arguments):
        losses.extend(made := build(*arguments))
        return made

    build = replay_buffer.make_loss
    monkeypatch.setattr(replay_buffer, "EpisodeAccounting", Both)
    monkeypatch.setattr(replay_buffer, "make_loss", make_loss)
    monkeypatch.setattr(
        replay_buffer, "SafetyGymEnv", lambda name, num_envs, seed: PointMass(num_envs, 20, seed)
    )
    rows = replay_buffer.main(["--limit=1", *SIZES])
    assert [row["episodes"] for row in rows] == [4, 4, 4]
    assert [row["multiplier"] for row in rows] == [value for value, _ in expected]
    assert rows[-1]["multiplier"] > 0
    ours, theirs = losses[0], expected[-1][1]
    assert ours.reward_unit == theirs.reward_unit != 1
    assert ours.cost_unit == theirs.cost_unit
    assert all(math.isfinite(row["loss_qvalue"]) for row in rows)
    assert capsys.readouterr().out.count("J_r") == 3
