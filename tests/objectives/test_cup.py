"""CUP's projection, against its definition."""

import pytest
import torch
from one_state import total
from point_mass import PointMass
from run_configs import point_mass_config
from samples import assert_gradients_are_differences, limit_state, make_actor, make_batch, perturb
from torch.distributions import kl_divergence

from safe_rl.algorithms import CUPUpdate, OnPolicy
from safe_rl.objectives import CUPLoss, PPOLoss, ProjectedMultiplier

FACTOR = (1 - 0.99 * 0.97) / (1 - 0.99)


def cup_loss(actor, *values):
    limits = [25.0] * len(values)
    multiplier = ProjectedMultiplier(limits, init=list(values), lr=0.01, highest=None)
    return CUPLoss(actor, multiplier, gamma=0.99, lmbda=0.97, entropy_coeff=0.01)


def moved_case(batch_size=(32,)):
    """A batch of π_k, anchored at π½, and a policy that has gone on from there."""
    actor = make_actor(width=4)
    batch = make_batch(actor, list(batch_size), 2)
    perturb(actor, 0.1)
    loss = cup_loss(actor, 0.5, 2.0)
    loss.prepare(batch, limit_state(0.0, 0.0))
    half = actor.get_dist(batch.select("observation"))
    perturb(actor, 0.1)
    return actor, batch, loss, half


def test_gradients_against_finite_differences():
    actor, batch, loss, _ = moved_case()
    loss, batch = loss.double(), batch.double()
    assert_gradients_are_differences(lambda: total(loss(batch)), actor)


def test_it_is_the_equation():
    actor, batch, loss, half = moved_case((4, 8))
    policy = actor.get_dist(batch.select("observation"))
    ratio = (policy.log_prob(batch["action"]) - batch["action_log_prob"]).exp()
    divergence = kl_divergence(policy.base_dist, half.base_dist).sum(-1)
    costs = (ratio[..., None] * batch["cost_advantage"]).mean((0, 1))
    assert "advantage" not in loss.in_keys
    found = loss(batch.select(*loss.in_keys))
    expected = divergence.mean() + FACTOR * (costs @ torch.tensor([0.5, 2.0]))
    expected = expected / (1 + FACTOR * 2.5)
    torch.testing.assert_close(found["loss_objective"], expected)
    torch.testing.assert_close(found["kl"], divergence.mean().detach())
    torch.testing.assert_close(found["cost_surrogate"], costs.detach())
    loss.prepare(batch, limit_state(0.0, 0.0, unit=[5.0, 2.0]))  # weighted, and reported as it is
    torch.testing.assert_close(loss(batch)["cost_surrogate"], costs.detach())


SETTINGS = {"optimizer": torch.optim.SGD, "num_passes": 3, "minibatch_size": 16}


def cup_update(actor, weight, **changed):
    multiplier = ProjectedMultiplier([25.0], init=weight, lr=0.01, highest=None)
    loss = PPOLoss(actor, clip_epsilon=0.2, entropy_coeff=0.0)
    return CUPUpdate(loss, multiplier, gamma=0.99, lmbda=0.97, **(SETTINGS | changed))


def test_without_a_weight_the_projection_stays_where_the_first_step_has_led():
    seen = {}
    for weight in (0.0, 1.0):
        torch.manual_seed(0)
        actor = make_actor()
        batch = make_batch(actor, [64], 1)
        seen[weight] = cup_update(actor, weight)(batch, limit_state(0.0))
    assert seen[0.0]["kl"] > 0
    assert seen[0.0]["projection_kl"] < 1e-6 < seen[1.0]["projection_kl"]
    assert seen[1.0]["cost_surrogate"] < seen[0.0]["cost_surrogate"]
    assert {"num_steps", "projection_num_steps"} < set(seen[0.0])


def test_the_first_step_of_a_run_knows_no_costs():
    """Also where a multiplier is at hand."""
    overrides = ("algo=cup", "cost_limits={cost_north: 1}")
    algorithm = OnPolicy.from_config(point_mass_config(*overrides), PointMass(2))
    first, projection = algorithm.policy_update.loss_modules().values()
    assert algorithm.multiplier is projection.multiplier
    assert first.multiplier is None
    assert "cost_advantage" not in first.in_keys
    assert first.actor_network is projection.actor_network is algorithm.actor


def test_both_optimisers_resume():
    actor = make_actor()
    batch = make_batch(actor, [16], 1)
    update, twin = (cup_update(actor, 1.0, optimizer=torch.optim.Adam) for _ in range(2))
    update(batch, limit_state(0.0))
    twin.load_state_dict(update.state_dict())
    for resumed, saved in ((twin, update), (twin.projection, update.projection)):
        state, expected = (each.optimizer.state_dict()["state"] for each in (resumed, saved))
        assert state
        assert torch.equal(state[0]["exp_avg"], expected[0]["exp_avg"])


def test_a_batch_without_an_anchor_is_refused():
    actor = make_actor()
    with pytest.raises(KeyError, match=r"anchor.*CUPLoss.prepare\(batch, limits\) writes it"):
        cup_loss(actor, 1.0)(make_batch(actor, [8], 1))
