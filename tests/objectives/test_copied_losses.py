"""Losses that are copied or moved: their networks are still those that they train."""

import copy
import pickle
from itertools import chain

import pytest
import torch

from safe_rl.models import make_actor, make_bounded_actor, make_critic
from safe_rl.objectives import BCLoss, CriticLoss, PPOLoss

SCALED = {"hidden_sizes": [4], "input_scale": torch.tensor([0.1, 1.0, 2.0])}  # a buffer
ACTOR = {**SCALED, "initial_log_std": -0.5}


def make_loss(kind):
    if kind is CriticLoss:
        return CriticLoss(make_critic(3, **SCALED), make_critic(3, out_key="cost_value", **SCALED))
    if kind is BCLoss:
        return BCLoss(make_bounded_actor(3, -torch.ones(2), torch.ones(2), **SCALED))
    return PPOLoss(make_actor(3, 2, **ACTOR), clip_epsilon=0.2, entropy_coeff=0.0)


@pytest.mark.parametrize("kind", [PPOLoss, CriticLoss, BCLoss])
@pytest.mark.parametrize(
    "change",
    [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss)), lambda loss: loss.double()],
    ids=["copied", "stored", "moved"],
)
def test_networks_share_the_tensors_of_their_loss(change, kind):
    loss = change(make_loss(kind))
    names = ["critic", "cost_critic"] if kind is CriticLoss else ["actor_network"]
    own = {tensor.data_ptr() for tensor in chain(loss.parameters(), loss.buffers())}
    for network in (getattr(loss, name) for name in names):
        for tensor in chain(network.parameters(), network.buffers()):
            assert tensor.data_ptr() in own
