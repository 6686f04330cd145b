"""Updates that are copied or stored, as processes and searches do, train their own networks."""

import copy
import pickle
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from test_replay_update import fill, make_td3

from safe_rl.algorithms import MinibatchUpdate, TRPOStep
from safe_rl.models import make_actor
from safe_rl.objectives import PPOLoss, TRPOLoss

ADAM = partial(torch.optim.Adam, lr=0.01)
REGION = {"target_kl": 0.01, "damping": 0.1, "cg_iterations": 5}
SEARCH = {"backtrack_coeff": 0.8, "max_backtracks": 10}
CHANGES = {"copied": copy.deepcopy, "stored": lambda x: pickle.loads(pickle.dumps(x))}


def make_policy():
    torch.manual_seed(0)
    actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
    with torch.no_grad():
        batch = actor(TensorDict(observation=torch.randn(16, 3), batch_size=[16]))
    return actor, batch.set("advantage", torch.randn(16, 1))


def make_minibatch_update():
    actor, batch = make_policy()
    loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.01)
    update = MinibatchUpdate(loss, optimizer=ADAM, num_passes=3, minibatch_size=None)
    return update, lambda update: update(batch.clone())


def make_trpo_step():
    actor, batch = make_policy()
    step = TRPOStep(TRPOLoss(actor, entropy_coeff=0.01), **REGION, **SEARCH)
    return step, lambda step: step(batch.clone())


def make_replay_update():
    def take(update):
        torch.manual_seed(1)
        update(fill(), 4)

    return make_td3(), take


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("make", [make_minibatch_update, make_trpo_step, make_replay_update])
def test_a_copy_trains_its_networks_and_no_others(make, change):
    update, take = make()
    take(update)  # so that an optimiser has moments
    other = CHANGES[change](update)
    before = TensorDict.from_module(update.loss).data.clone()
    take(other)
    assert (TensorDict.from_module(update.loss).data == before).all()
    take(update)
    after, copied = (TensorDict.from_module(part.loss).data for part in (update, other))
    assert (after == copied).all()
    changed = {key[0] for key, value in after.items(True, True) if (value != before[key]).any()}
    expected = {"actor_network_params"}
    if make is make_replay_update:
        expected |= {"qvalue_network_params", "target_qvalue_network_params"}
    assert expected <= changed
    for key, tensor in TensorDict.from_module(other.loss.actor_network).data.items(True, True):
        assert (tensor == copied["actor_network_params", *key]).all()


@pytest.mark.parametrize("first", ["loss", "optimizer"])
def test_an_optimiser_that_is_copied_with_its_loss_trains_it(first):
    actor, batch = make_policy()
    parts = {"loss": (loss := PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0))}
    parts["optimizer"] = ADAM(loss.parameters())
    order = sorted(parts, key=lambda name: name != first)
    copied = dict(zip(order, copy.deepcopy([parts[name] for name in order]), strict=True))
    losses = copied["loss"](batch)
    losses["loss_objective"].backward()
    copied["optimizer"].step()
    own, new = (TensorDict.from_module(part["loss"]).data for part in (parts, copied))
    assert any((new[key] != value).any() for key, value in own.items(True, True))
