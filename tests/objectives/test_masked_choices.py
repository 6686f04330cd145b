"""Policies some of whose choices are masked: divergences have gradients, which are right."""

import pytest
import torch
from samples import NUM_OBS, assert_gradients_are_differences, perturb
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MaskedCategorical, ProbabilisticActor

from safe_rl.objectives import CUPLoss, FOCOPSLoss, LagrangeMultiplier

SETTINGS = {
    CUPLoss: {"gamma": 0.99, "lmbda": 0.97},
    FOCOPSLoss: {"temperature": 1.5, "max_state_kl": 9.0},
}


@pytest.mark.parametrize("kind", SETTINGS)
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
    multiplier = LagrangeMultiplier([1.0], init=1.0, lr=0.1)
    loss = kind(actor, multiplier, **SETTINGS[kind], entropy_coeff=0.1)
    loss.anchor(batch)
    perturb(actor, 0.3)

    def total():
        losses = loss(batch)
        return losses["loss_objective"] + losses["loss_entropy"]

    assert_gradients_are_differences(total, actor)
