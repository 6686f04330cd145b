"""Losses that are copied, moved, restored or given other parameters: which ones they use."""

import copy
import pickle
from itertools import chain

import pytest
import torch
from q_losses import lagrange, make_steps, told
from q_losses import make_loss as make_q_loss
from tensordict import TensorDict

from safe_rl.models import make_actor, make_bounded_actor, make_critic
from safe_rl.objectives import BCLoss, CriticLoss, PPOLoss

SCALED = {"hidden_sizes": [4], "input_scale": torch.tensor([0.1, 1.0, 2.0])}  # a buffer
ACTOR = {**SCALED, "initial_log_std": -0.5}
CHANGES = {
    "copied": copy.deepcopy,
    "stored": lambda loss: pickle.loads(pickle.dumps(loss)),
    "moved": lambda loss: loss.double().float(),
}


def make_loss(kind):
    if kind is CriticLoss:
        return CriticLoss(make_critic(3, **SCALED), make_critic(3, out_key="cost_value", **SCALED))
    if kind is BCLoss:
        return BCLoss(make_bounded_actor(3, -torch.ones(2), torch.ones(2), **SCALED))
    return PPOLoss(make_actor(3, 2, **ACTOR), clip_epsilon=0.2, entropy_coeff=0.0)


def losses_of(loss, steps):
    """Always with the same draws."""
    torch.manual_seed(1)
    return loss(steps.clone()).detach().to_dict()


@pytest.mark.parametrize("kind", [PPOLoss, CriticLoss, BCLoss])
@pytest.mark.parametrize("change", CHANGES)
def test_networks_share_the_tensors_of_their_loss(change, kind):
    loss = CHANGES[change](make_loss(kind))
    names = ["critic", "cost_critic"] if kind is CriticLoss else ["actor_network"]
    own = {tensor.data_ptr() for tensor in chain(loss.parameters(), loss.buffers())}
    for network in (getattr(loss, name) for name in names):
        for tensor in chain(network.parameters(), network.buffers()):
            assert tensor.data_ptr() in own


@pytest.mark.parametrize("kind", ["sac", "td3"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_loss_learns_from_its_own_networks_after_it_was(change, kind):
    loss, fresh, steps = *(make_q_loss(kind, lagrange(1.0, 1.0)) for _ in range(2)), make_steps()
    loss(steps.clone())
    (changed := CHANGES[change](loss)).load_state_dict(fresh.state_dict())
    torch.testing.assert_close(losses_of(changed, steps), losses_of(fresh, steps))


@pytest.mark.parametrize("kind", ["sac", "td3", "cal"])
def test_parameters_in_place_of_its_own_are_used_and_no_longer_than_they_are_there(kind):
    loss, fresh, steps = *(make_q_loss(kind, lagrange(1.0, 1.0)) for _ in range(2)), make_steps()
    before, expected = (losses_of(each, steps)["loss_qvalue"] for each in (loss, fresh))
    for warm in (True, False):  # whether the loss has been called with its own ones
        loss = loss if warm else copy.deepcopy(loss)
        with TensorDict.from_module(fresh).data.to_module(loss):
            torch.testing.assert_close(losses_of(loss, steps)["loss_qvalue"], expected)
        torch.testing.assert_close(losses_of(loss, steps)["loss_qvalue"], before)
    assert (before - expected).abs() > 1e-4
    loss(steps.clone())["loss_qvalue"].backward()


@pytest.mark.parametrize("kind", ["sac", "td3", "cal"])
def test_a_new_loss_with_the_state_of_another_one_needs_no_batch(kind):
    known = told(make_q_loss(kind, lagrange(1.0, 1.0)), [2.0, 3.0], rewards=[1.0, 2.0])
    fresh = make_q_loss(kind, lagrange(1.0, 1.0), is_prepared=False)
    with pytest.raises(ValueError, match=r"not know the scales.*: call prepare\(batch, limits\)"):
        fresh(make_steps())
    fresh.load_state_dict(known.state_dict())
    steps = make_steps()
    torch.testing.assert_close(losses_of(known, steps), losses_of(fresh, steps))
