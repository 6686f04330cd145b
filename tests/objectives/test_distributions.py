"""Policies of any distribution: KL and entropy against torch, samples and differences."""

import functools
import math

import pytest
import torch
from policy_kinds import KINDS, SAMPLED_KL, make_actor, make_case
from samples import NUM_OBS, TRUST_REGION, assert_gradients_are_differences, limit_state, perturb
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import nn
from torch.distributions import Categorical, Independent, kl_divergence
from torchrl.modules import MaskedCategorical, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from safe_rl import objectives
from safe_rl.algorithms import CPOStep, MinibatchUpdate, TRPOStep
from safe_rl.objectives.distributions import entropy, kl
from safe_rl.objectives.trust_region import policy_in


def behaviour(actor, batch):
    """The distribution that collected a batch, from the entries that the actor wrote into it."""
    return actor.build_dist_from_params(batch)


@pytest.mark.parametrize("kind", KINDS)
def test_ppo_surrogate_agrees_with_torchrl(kind):
    actor, batch = make_case(kind)
    perturb(actor, 0.1)
    theirs = ClipPPOLoss(actor, None, critic_coeff=None, clip_epsilon=0.02, entropy_coeff=0.0)
    expected = theirs(batch.clone())
    losses = objectives.PPOLoss(actor, clip_epsilon=0.02, entropy_coeff=0.01)(batch)
    for key in ("loss_objective", "clip_fraction", "ESS"):
        torch.testing.assert_close(losses[key], expected[key])
    torch.testing.assert_close(losses["loss_entropy"], -0.01 * losses["entropy"])
    assert losses["clip_fraction"] > 0
    gradients = (
        torch.autograd.grad(found["loss_objective"], [*actor.parameters()])
        for found in (losses, expected)
    )
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("kind", sorted(set(KINDS) - SAMPLED_KL))
def test_kl_and_entropy_in_closed_form(kind):
    actor, batch = make_case(kind)
    perturb(actor, 0.1)
    losses = objectives.PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)(batch)
    present, past = policy_in(actor, batch), behaviour(actor, batch)
    if "tanh" in kind:  # torch knows the divergence of what is underneath
        present, past = present.base_dist, past.base_dist
    else:
        torch.testing.assert_close(losses["entropy"], present.entropy().mean().detach())
    expected = kl_divergence(present, past).mean()
    torch.testing.assert_close(losses["kl"], expected.detach())
    assert losses["kl"] > 0
    assert not losses["kl"].requires_grad


@pytest.mark.parametrize("kind", sorted(SAMPLED_KL))
def test_sampled_kl_is_the_divergence_on_average(kind):
    """Against the mean of log p − log q over samples of p, both with a hundred thousand samples."""
    actor = make_actor(kind)
    batch = TensorDict(observation=torch.ones(100_000, NUM_OBS), batch_size=[100_000])
    with torch.no_grad():
        past = policy_in(actor, batch)
        action = past.sample()
        perturb(actor, 0.1)
        present = policy_in(actor, batch)
        log_weight = present.log_prob(action) - past.log_prob(action)
        ratio = log_weight.exp()
        found = (ratio * log_weight - ratio + 1).mean()
        own = present.sample()
        expected = (present.log_prob(own) - past.log_prob(own)).mean()
        torch.testing.assert_close(kl(present, past, log_weight).mean(), found)
    assert found.item() == pytest.approx(expected.item(), rel=0.1, abs=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_entropy_bonus_is_the_entropy_and_its_slope(kind):
    """Against the mean of −log p over other samples; slopes by differences of that with p fixed."""
    actor = make_actor(kind)
    batch = TensorDict(observation=torch.ones(50_000, NUM_OBS), batch_size=[50_000])
    found = entropy(policy_in(actor, batch)).mean()
    with torch.no_grad():
        own = policy_in(actor, batch)
        expected = -own.log_prob(own.sample()).mean()
    assert found.item() == pytest.approx(expected.item(), abs=0.02)
    bias = [module for module in actor.modules() if isinstance(module, nn.Linear)][-1].bias
    (slope,) = torch.autograd.grad(found, bias)
    numbers = []
    for index in range(len(bias)):
        values = []
        for size in (0.1, -0.1):
            with torch.no_grad():
                bias[index] += size
                torch.manual_seed(0)
                moved = policy_in(actor, batch)
                values.append(-moved.log_prob(moved.sample()).mean())
                bias[index] -= size
        numbers.append((values[0] - values[1]) / 0.2)
    torch.testing.assert_close(slope, torch.stack(numbers), atol=0.03, rtol=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_every_update_takes_every_policy(kind):
    actor, batch = make_case(kind, samples=200)
    multiplier = objectives.LagrangeMultiplier([1.0], init=1.0, lr=0.1)
    ppo = objectives.PPOLagrangianLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.01)
    adam = functools.partial(torch.optim.Adam, lr=1e-2)
    update = MinibatchUpdate(ppo, optimizer=adam, num_passes=10, minibatch_size=None)
    before = ppo(batch)["loss_objective"].item()
    assert update(batch, limit_state(0.0))["num_steps"] == 10
    assert ppo(batch)["loss_objective"] < before
    for step, violation in (
        (TRPOStep(objectives.TRPOLoss(actor, entropy_coeff=0.0), **TRUST_REGION), None),
        (CPOStep(objectives.CPOLoss(actor, entropy_coeff=0.0), **TRUST_REGION), -5.0),
    ):
        with torch.no_grad():  # another batch, of the policy as it is
            batch = actor(batch.select("observation", "advantage", "cost_advantage"))
        start = step.loss(batch)["loss_objective"].item()
        state = None if violation is None else limit_state(violation, length=50.0)
        metrics = step(batch, state)
        assert metrics["step_fraction"] > 0
        assert 0 < metrics["kl"] <= TRUST_REGION["target_kl"]
        assert step.loss(batch)["loss_objective"] < start


def test_parameters_are_read_where_the_actor_writes_them():
    actor = ProbabilisticActor(
        TensorDictModule(nn.Linear(NUM_OBS, 5), ["observation"], [("pi", "logits")]),
        in_keys={"logits": ("pi", "logits")},
        distribution_class=Categorical,
        return_log_prob=True,
    )
    loss = objectives.PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)
    assert ("pi", "logits") in loss.in_keys
    assert "loc" not in loss.in_keys
    batch = TensorDict(observation=torch.randn(8, NUM_OBS), batch_size=[8])
    with torch.no_grad():
        actor(batch)
    batch["advantage"] = torch.randn(8, 1)
    assert loss(batch)["kl"] == 0
    wrong = batch.clone()
    wrong["pi", "logits"][3, 0] = torch.nan
    with pytest.raises(FloatingPointError, match=r"logits.*1 of 8"):
        TRPOStep(objectives.TRPOLoss(actor, entropy_coeff=0.0), **TRUST_REGION)(wrong)
    del batch["pi", "logits"]
    with pytest.raises(KeyError, match="behaviour policy's"):
        loss(batch)


@pytest.mark.parametrize("names", [["wheel", "gear"], ["wheel"]])
def test_a_policy_of_composite_actions_is_refused(names):
    parts = dict.fromkeys(names, Categorical)
    actor = ProbabilisticActor(
        TensorDictModule(nn.Identity(), ["params"], ["params"]),
        in_keys=["params"], out_keys=names, return_log_prob=True,
        distribution_class=functools.partial(CompositeDistribution, distribution_map=parts),
    )  # fmt: skip
    with pytest.raises(TypeError, match=r"samples \['wheel'.*\].* no composite"):
        objectives.PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)


PROJECTIONS = {
    objectives.CUPLoss: {"gamma": 0.99, "lmbda": 0.97},
    objectives.FOCOPSLoss: {"temperature": 1.5, "max_state_kl": 9.0},
}


@pytest.mark.parametrize("kind", PROJECTIONS)
def test_choices_that_are_masked_leave_the_gradient_of_a_divergence_a_number(kind):
    """Against finite differences; the mask is part of the observation."""
    net = nn.Sequential(nn.Linear(NUM_OBS, 6), nn.Tanh(), nn.Linear(6, 4)).double()
    actor = ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits", "mask"],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
    )
    batch = TensorDict(observation=torch.randn(32, NUM_OBS).double(), batch_size=[32])
    batch["mask"] = torch.rand(32, 4) < 0.6
    batch["mask"][:, 0] = True
    with torch.no_grad():
        actor(batch)
    batch["advantage"], batch["cost_advantage"] = torch.randn(2, 32, 1).double()
    multiplier = objectives.LagrangeMultiplier([1.0], init=1.0, lr=0.1)
    loss = kind(actor, multiplier, **PROJECTIONS[kind], entropy_coeff=0.1)
    loss.prepare(batch, limit_state(0.0))
    perturb(actor, 0.3)

    def total():
        losses = loss(batch)
        return losses["loss_objective"] + losses["loss_entropy"]

    assert_gradients_are_differences(total, actor)


def test_the_entropy_of_a_saturated_policy_is_that_of_its_normal_and_the_slope_of_tanh():
    """Far out log tanh'(x) is 2 log 2 − 2 |x|; actions there are rounded to the bound."""
    normal = torch.full((50_000, 1), 20.0), torch.full((50_000, 1), 0.5)
    squashed = TanhNormal(*normal, low=-1.0, high=1.0, event_dims=1)
    expected = Independent(torch.distributions.Normal(*normal), 1).entropy() + 2 * math.log(2) - 40
    torch.testing.assert_close(entropy(squashed).mean(), expected.mean(), atol=0.05, rtol=0)
