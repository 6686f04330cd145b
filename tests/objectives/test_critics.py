"""Critic losses against torch's own regression loss and numbers worked out by hand."""

import itertools

import pytest
import torch
from samples import NUM_OBS, make_critic
from tensordict import TensorDict
from torch.nn.functional import mse_loss

from safe_rl.objectives.critics import CriticLoss, critic_bias, explained_variance


def make_targets(batch_size, num_costs):
    return TensorDict(
        observation=torch.randn(*batch_size, NUM_OBS),
        value_target=torch.randn(*batch_size, 1),
        cost_value_target=torch.randn(*batch_size, num_costs),
        batch_size=batch_size,
    )


@pytest.mark.parametrize("batch_size", [[64], [4, 16]])
@pytest.mark.parametrize("num_costs", [1, 3])
def test_squared_errors(batch_size, num_costs):
    critic, cost_critic = make_critic(), make_critic("cost_value", num_costs)
    batch = make_targets(batch_size, num_costs)
    losses = CriticLoss(critic, cost_critic)(batch)
    value, cost_value = (net.module(batch["observation"]) for net in (critic, cost_critic))
    expected = mse_loss(value, batch["value_target"])
    expected_cost = num_costs * mse_loss(cost_value, batch["cost_value_target"])
    torch.testing.assert_close(losses["loss_critic"], expected)
    torch.testing.assert_close(losses["loss_cost_critic"], expected_cost)
    assert losses["explained_variance"].shape == ()
    assert losses["cost_explained_variance"].shape == (num_costs,)
    assert batch.get("state_value", None) is None


def test_one_critic_alone():
    loss = CriticLoss(make_critic())
    losses = loss(make_targets([8], 1))
    assert set(losses.keys()) == set(loss.out_keys) == {"loss_critic", "explained_variance"}
    assert set(loss.in_keys) == {"observation", "value_target"}


def test_explained_variance_by_hand():
    target = torch.tensor([[0.0, 1.0, 5.0], [2.0, 3.0, 5.0]])
    # the first is off by the same everywhere, which is no variance
    prediction = torch.tensor([[3.0, 2.0, 4.0], [5.0, 2.0, 6.0]])
    # Residual variances 0, 1 and 1 against target variances 1, 1 and 0.
    assert explained_variance(prediction, target).tolist() == [1.0, 0.0, 0.0]


@pytest.mark.long
def test_it_compiles():
    torch._dynamo.reset()
    loss, batch = CriticLoss(make_critic(), make_critic("cost_value", 2)), make_targets([8], 2)
    expected, compiled = loss(batch), torch.compile(loss, fullgraph=True, backend="eager")(batch)
    for key in loss.out_keys:
        torch.testing.assert_close(compiled[key], expected[key])


def test_errors_say_what_to_change():
    loss = CriticLoss(make_critic(), make_critic("cost_value", 2))
    with pytest.raises(ValueError, match="cost_critic needs one output per target"):
        loss(make_targets([8], 3))
    with pytest.raises(KeyError, match="value targets"):
        loss(make_targets([8], 2).exclude("value_target"))


@pytest.mark.parametrize("gamma", [0.9, 1.0, 0.0])
def test_the_bias_is_by_how_much_predictions_exceed_what_was_paid(gamma):
    """Where an episode is cut, n steps later, by the prediction there, with the weight 1 − γⁿ."""
    values, costs = torch.randn(2, 6, 20, 2) + 1
    terminated = torch.rand(6, 20, 1) < 0.1
    done = terminated | (torch.rand(6, 20, 1) < 0.1)
    total, weight = torch.zeros(2), 0.0
    for row, step in itertools.product(range(6), range(20)):
        paid, factor, last = torch.zeros(2), 1.0, step
        while not done[row, last] and last < 19:
            paid, factor, last = paid + factor * costs[row, last], gamma * factor, last + 1
        later = costs if terminated[row, last] else values
        total += values[row, step] - paid - factor * later[row, last]
        weight += 1.0 if terminated[row, last] else 1 - factor
    found = critic_bias(values, costs, done, terminated, gamma)
    torch.testing.assert_close(found, total / weight, atol=1e-4, rtol=1e-4)


def test_no_bias_is_known_of_a_step_of_which_no_cost_is():
    nothing = torch.zeros(1, 1, 1, dtype=torch.bool)
    assert critic_bias(torch.ones(1, 1, 1), torch.ones(1, 1, 1), nothing, nothing, 0.9).isnan()
