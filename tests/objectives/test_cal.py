"""CAL against the augmented Lagrangian's own gradient, and its limit in the critics' terms."""

from dataclasses import replace

import pytest
import torch
from q_losses import lagrange
from q_losses import make_loss as make_q_loss
from tensordict import TensorDict

from safe_rl.objectives import LimitState
from safe_rl.objectives.sac import discounted_share


def make_loss(init=(2.0, 0.5), **keys):
    keys = {"ratio_memory": 0.5, **keys}
    return make_q_loss("cal", lagrange(*init), networks=4, is_prepared=False, **keys)


def prepare(loss, costs, unit=(1.0, 1.0)):
    state = LimitState.of(cost=costs, limit=[25.0, 10.0], length=1000.0)
    rewards = TensorDict({"next": {"reward": torch.zeros(2, 3, 1)}}, [2, 3])
    loss.prepare(rewards, replace(state, unit=torch.tensor(unit)))


def test_the_conversion_is_the_discounted_sum_of_even_costs():
    for gamma, steps in ((0.99, 400), (0.9, 7), (1.0, 5)):
        even = sum(gamma**t / steps for t in range(steps))
        assert discounted_share(gamma, torch.tensor(float(steps))).item() == pytest.approx(even)


@pytest.mark.parametrize(
    ("away", "is_active"), [((0.3, -0.01), (True, True)), ((-9.0, 0.1), (False, True))]
)
def test_its_gradient_is_that_of_the_augmented_lagrangian(away, is_active):
    """E[α log π − Q_r] + Σ max(0, λ + c (E[Q] − d') / u)² / 2c."""
    loss, states = make_loss(pessimism=0.5).double(), torch.randn(6, 3).double()
    steps, unit = TensorDict(observation=states, batch_size=[6]), torch.tensor([1.0, 0.5]).double()
    prepare(loss, [0.0, 0.0], unit=(1.0, 0.5))
    torch.manual_seed(1)
    dist = loss.actor_network.get_dist(steps)
    action = dist.rsample()
    inputs = steps.clone().set("action", action)
    reward = loss.qvalue_network(inputs)["state_action_value"].min(0).values.squeeze(-1)
    values = loss.cost_qvalue_network(inputs)["cost_value"]
    spread = (values - values.mean(0)).square().mean(0).sqrt()
    charged = (values.mean(0) + 0.5 * spread).mean(0)
    loss.discounted_limit.copy_(charged.detach() - torch.tensor(away) * unit)
    inner = loss.multiplier.value + 10 * (charged - loss.discounted_limit) / unit
    penalty = inner.clamp_min(0).square().sum() / 20
    augmented = (0.2 * dist.log_prob(action) - reward).mean() + penalty
    torch.manual_seed(1)
    found = loss.actor_losses(steps)
    assert tuple((found["cost_weight"] > 0).tolist()) == is_active
    parameters = [p for p in loss.actor_network_params.values(True, True) if p.requires_grad]
    normalised = found["loss_actor"] * (1 + found["cost_weight"] @ unit)
    gradients = (torch.autograd.grad(value, parameters) for value in (normalised, augmented))
    torch.testing.assert_close(*gradients, atol=1e-6, rtol=0)


def test_costs_are_free_until_the_limit_is_known():
    loss = make_loss()
    assert not loss.cost_weights(torch.rand(1, 4, 6, 2)).any()


def test_the_limit_is_where_critics_say_that_episodes_are_at_theirs():
    """Critics 30 % below even spreading: half of their value is the limit if J_c is twice it."""
    loss = make_loss(gamma=0.99, init=(1.0, 1.0))
    prepare(loss, [50.0, 8.0], unit=(1.0, 2.0))
    # nothing is known of the critics: the article's conversion
    torch.testing.assert_close(loss.discounted_limit, torch.tensor([2.5, 1.0]), rtol=1e-3, atol=0)
    assert loss.cost_unit.tolist() == [1.0, 2.0]
    for _ in range(3):
        for _ in range(4):
            loss.cost_weights(torch.tensor([3.5, 0.56]).expand(1, 4, 6, 2))
        prepare(loss, [50.0, 8.0])
    torch.testing.assert_close(loss.discounted_limit, torch.tensor([1.75, 0.7]))
    weights = loss.cost_weights(torch.tensor([1.8, 0.65]).expand(1, 4, 6, 2))
    torch.testing.assert_close(weights, torch.tensor([1.5, 0.5]))


def test_a_cost_that_no_episode_has_told_yet_leaves_the_averages_alone():
    loss = make_loss(gamma=0.99)
    for costs in ([torch.nan, 40.0], [50.0, 40.0]):
        loss.cost_weights(torch.full((1, 4, 6, 2), 2.0))
        prepare(loss, costs)
    weight = 1 - loss.ratio_memory
    torch.testing.assert_close(loss.known_costs[:, 0], weight * torch.tensor([2.0, 50.0]))
    assert loss.discounted_limit.isfinite().all()


def test_the_limit_follows_what_batches_say_and_not_too_far():
    loss = make_loss(gamma=0.99, ratio_memory=0.75)
    rows = [([40.0, 0.0], (1.0, 9.0)), ([20.0, 0.0], (4.0, 9.0)), ([60.0, 0.0], (30.0, 9.0))]
    said = spent = 0.0
    for costs, values in rows:
        loss.cost_weights(torch.tensor(values).expand(1, 4, 6, 2))
        prepare(loss, costs)
        said, spent = 0.75 * said + 0.25 * values[0], 0.75 * spent + 0.25 * costs[0]
        ratio = min(max(said / spent, 0.05), 0.2)  # one below, one within, one above
        assert loss.discounted_limit[0].item() == pytest.approx(25 * ratio, rel=1e-3)
        # critics that say that there is a cost where there is none
        assert loss.discounted_limit[1].item() == pytest.approx(1.0, rel=1e-3)
    other = make_loss(gamma=0.99)
    other.load_state_dict(loss.state_dict())
    for each in (loss, other):
        prepare(each, [10.0, 1.0])
    assert torch.equal(loss.discounted_limit, other.discounted_limit)
