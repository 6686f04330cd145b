"""Padded batches give what the same trajectories give without padding."""

import functools

import pytest
import torch
from samples import TRUST_REGION, limit_state, make_actor, make_batch, make_critic, make_rollout
from tensordict import TensorDict
from torchrl.collectors.utils import split_trajectories
from torchrl.objectives.value import GAE

from safe_rl.algorithms import CPOStep, MinibatchUpdate, TRPOStep
from safe_rl.objectives import CostGAE, CPOLoss, TRPOLoss, VectorGAE, normalise_advantages
from safe_rl.objectives.surrogate import effective_sample_size

N, T = 3, 20
SETTINGS = {"gamma": 0.97, "lmbda": 0.9, "value_target": "lambda_return"}


def make_trajectories(critics=()):
    """Whole and cut episodes, also one that ends with the batch."""
    done = torch.rand(N, T, 1) < 0.15
    done[0, 4], done[1, -1], done[2, -1] = True, True, False
    rollout = make_rollout(critics, N, T, costs=("cost_a", "cost_b"), done=done)
    starts = torch.nn.functional.pad(done.squeeze(-1)[:, :-1].long(), (1, 0))
    rollout["collector", "traj_ids"] = starts.cumsum(1) + 100 * torch.arange(N)[:, None]
    return rollout


def samples_of(padded, key):
    return padded[key][padded["collector", "mask"]]


@pytest.mark.parametrize("lmbda", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("target", ["lambda_return", "return_to_go"])
@pytest.mark.parametrize("precomputed", [False, True])
def test_advantages_of_split_trajectories(lmbda, target, precomputed):
    critics = make_critic(), make_critic("cost_value", 2)
    rollout = make_trajectories(critics if precomputed else ())
    # the mask alone says where the trajectories end
    padded = split_trajectories(rollout.clone()).exclude(("collector", "traj_ids"))
    assert not padded["collector", "mask"].all()
    settings = SETTINGS | {"lmbda": lmbda, "value_target": target}
    reward, cost = (None, None) if precomputed else critics
    for data in (rollout, padded):
        VectorGAE(reward, **settings)(data)
        CostGAE(["cost_a", "cost_b"], cost, **settings)(data)
    padding = ~padded["collector", "mask"]
    for key in ("advantage", "value_target", "cost_advantage", "cost_value_target"):
        expected = rollout[key].flatten(0, 1)
        torch.testing.assert_close(samples_of(padded, key), expected, atol=1e-5, rtol=1e-5)
        assert not padded[key][padding].any()
    if not precomputed and lmbda:
        fresh = rollout.select("observation", "next")
        theirs = GAE(gamma=0.97, lmbda=lmbda, value_network=critics[0])(fresh)
        expected = theirs["advantage"].flatten(0, 1)
        found = samples_of(padded, "advantage")
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


def test_what_stands_in_the_padding_does_not_matter():
    critic = make_critic()
    padded = split_trajectories(make_trajectories())
    spoilt = padded.clone()
    for data in (spoilt, spoilt["next"]):
        data["observation"][~padded["collector", "mask"]] = torch.nan
    spoilt["next", "reward"][~padded["collector", "mask"]] = torch.inf
    for data in (padded, spoilt):
        VectorGAE(critic, **SETTINGS)(data)
    assert torch.equal(spoilt["advantage"], padded["advantage"])


def padded_pair(num_costs=1, samples=60):
    """The same samples as a flat batch and as one with padding that holds nonsense."""
    actor = make_actor()
    flat = make_batch(actor, [samples], num_costs)
    flat["value_target"], flat["cost_value_target"] = torch.randn(2, samples, 1)
    flat["advantage"] += (flat["action"] - flat["loc"])[:, :1]
    mask = torch.zeros(10, 12, dtype=torch.bool)
    for row, length in enumerate([12, 3, 1, 7, 9, 2, 5, 8, 11, 2]):
        mask[row, :length] = True
    padded = TensorDict(
        {key: 5 + torch.rand(10, 12, *value.shape[1:]) for key, value in flat.items()}, [10, 12]
    )
    for key, value in flat.items():
        padded[key][mask] = value
    padded["collector", "mask"] = mask
    return actor, flat, padded


def test_normalisation():
    _, flat, padded = padded_pair(2)
    for data in (flat, padded):
        normalise_advantages(data)
    for key in ("advantage", "cost_advantage"):
        torch.testing.assert_close(samples_of(padded, key), flat[key])


SGD = functools.partial(torch.optim.SGD, lr=0.1)
PASSES = {"optimizer": SGD, "num_passes": 3, "minibatch_size": None}
REGION = TRUST_REGION | {"cg_iterations": 10}
UPDATES = {
    "minibatch": (MinibatchUpdate, TRPOLoss, PASSES),
    "trpo": (TRPOStep, TRPOLoss, REGION),
    "cpo": (CPOStep, CPOLoss, REGION),
}


@pytest.mark.parametrize("kind", UPDATES)
@pytest.mark.parametrize("key", ["auto", "kept"])
def test_updates(kind, key):
    results = []
    for index in (0, 1):
        torch.manual_seed(5)
        actor, *batches = padded_pair()
        if key != "auto":
            batches[1].rename_key_(("collector", "mask"), key)
        make, loss, settings = UPDATES[kind]
        update = make(loss(actor, entropy_coeff=0.0), **settings)
        update.loss.loss_mask_key = key
        metrics = update(batches[index], limit_state(-1.0, length=20.0))
        ess = update.loss(batches[index])["ESS"]
        results.append(([p.detach().clone() for p in actor.parameters()], metrics["kl"], ess))
    torch.testing.assert_close(results[0], results[1])
    assert results[0][1] > 0


def test_padding_has_no_weight_in_the_effective_sample_size():
    weights, mask = torch.tensor([1.0, 3.0, 100.0]), torch.tensor([True, True, False])
    share = effective_sample_size(weights.log(), mask)  # (1 + 3)² / (1² + 3²) of two samples
    assert share.item() == pytest.approx(0.8)
