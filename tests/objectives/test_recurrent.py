"""Policies and critics with a memory of TorchRL's own: what is estimated of their sequences."""

import pytest
import torch
from point_mass import PointMass
from samples import TRUST_REGION, limit_state
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Normal, kl_divergence
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.modules import IndependentNormal, LSTMModule, ProbabilisticActor, set_recurrent_mode

from safe_rl.algorithms import TRPOStep
from safe_rl.collectors import make_collector
from safe_rl.objectives import CUPLoss, LagrangeMultiplier, TRPOLoss, VectorGAE

GAMMA = {"gamma": 0.99, "lmbda": 0.95, "value_target": "lambda_return"}


def remembering(name):
    """An encoder and an LSTM, with states of a name of their own."""
    memory = LSTMModule(
        input_size=8,
        hidden_size=6,
        in_keys=[f"{name}_features", f"{name}_hidden", f"{name}_cell"],
        out_keys=[name, ("next", f"{name}_hidden"), ("next", f"{name}_cell")],
    )
    encoder = nn.Sequential(nn.Linear(4, 8), nn.Tanh())
    return TensorDictModule(encoder, ["observation"], [f"{name}_features"]), memory


@pytest.fixture
def collected():
    """An actor, a critic, and a batch that both have stepped: episodes of 20 in rows of 50."""
    acting, valuing = remembering("acting"), remembering("valuing")
    head = nn.Sequential(nn.Linear(6, 2), AddStateIndependentNormalScale(2))
    actor = ProbabilisticActor(
        TensorDictSequential(*acting, TensorDictModule(head, ["acting"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    value = TensorDictModule(nn.Linear(6, 1), ["valuing"], ["state_value"])
    critic = TensorDictSequential(*valuing, value)
    with torch.no_grad():
        for parameter in (*actor.parameters(), *critic.parameters()):
            parameter.mul_(3)  # so that what is remembered makes a difference
    states = (memory.make_tensordict_primer() for _, memory in (acting, valuing))
    env = TransformedEnv(PointMass(4, 20), Compose(InitTracker(), *states))
    policy = TensorDictSequential(actor, critic)
    batches = iter(make_collector(env, policy, frames_per_batch=4 * 50))
    next(batches)
    return actor, critic, next(batches).clone()


@pytest.mark.parametrize("is_recurrent", [False, True])
def test_every_step_has_the_value_that_it_had_when_it_was_taken(collected, is_recurrent):
    _, critic, batch = collected
    expected = batch.clone()
    with torch.no_grad(), set_recurrent_mode(False):
        critic(expected["next"])
    VectorGAE(None, **GAMMA)(expected)
    with set_recurrent_mode(is_recurrent):
        VectorGAE(critic, **GAMMA)(batch)
    torch.testing.assert_close(batch["advantage"], expected["advantage"])


def test_a_critic_that_was_not_stepped_remembers_all_the_same(collected):
    _, critic, batch = collected
    for name in ("valuing_hidden", "valuing_cell"):
        batch[name][:, 1:] = 0
    before = batch["state_value"].clone()
    values = VectorGAE(critic, **GAMMA)(batch)["state_value"]
    open_until_done = batch["is_init"].cumsum(1).squeeze(-1) == 0
    torch.testing.assert_close(values[open_until_done], before[open_until_done])


def sequence_kl(actor, batch):
    """Mean divergence of the policy, read in sequences, from the one that collected the batch."""
    with torch.no_grad(), set_recurrent_mode(True):
        now = actor(batch.select(*actor.in_keys))
    present, past = (Normal(each["loc"], each["scale"]) for each in (now, batch))
    return kl_divergence(present, past).sum(-1).mean()


def test_the_trust_region_is_that_of_sequences(collected):
    actor, _, batch = collected
    batch["advantage"] = torch.randn(4, 50, 1)
    settings = TRUST_REGION | {"target_kl": 0.05, "damping": 1e-3, "cg_iterations": 20}
    step = TRPOStep(TRPOLoss(actor, entropy_coeff=0.0), **settings)
    kl = step(batch)["kl"]
    assert kl > 0.02
    torch.testing.assert_close(sequence_kl(actor, batch), kl)


def test_projections_start_from_the_policy_of_sequences(collected):
    actor, _, batch = collected
    multiplier = LagrangeMultiplier({"cost": 1.0}, init=0.5, lr=0.05)
    loss = CUPLoss(actor, multiplier, entropy_coeff=0.0, gamma=0.99, lmbda=0.95)
    batch["advantage"] = batch["cost_advantage"] = torch.randn(4, 50, 1)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.1)
        assert loss(loss.prepare(batch, limit_state(0.0)))["kl"].abs() < 1e-6
    assert sequence_kl(actor, batch) > 1e-3
