"""Critics of Gaussian and quantile costs against closed forms, samples and finite differences."""

import numpy as np
import pytest
import torch
from q_losses import lagrange, make_loss
from samples import assert_gradients_are_differences
from scipy import integrate, stats
from tensordict import TensorDict

from safe_rl.objectives import GaussianCosts, QuantileCosts
from safe_rl.objectives.cost_values import gaussian_tail

GAUSSIAN = GaussianCosts(tail=0.3)


def make_loss_with(values, *multipliers, **keys):
    return make_loss("sac", lagrange(*multipliers), cost_values=values, **keys)


@pytest.mark.parametrize("tail", [0.01, 0.1, 0.3, 0.5, 0.9, 1.0])
def test_the_tail_is_the_mean_beyond_the_quantile(tail):
    beyond = stats.norm.isf(tail)
    mean = integrate.quad(lambda x: x * stats.norm.pdf(x), beyond, np.inf)[0] / tail
    assert gaussian_tail(tail) == pytest.approx(mean, rel=1e-6)


def test_the_actor_pays_the_tail_and_its_gradient_is_that_of_finite_differences():
    loss = make_loss_with(GAUSSIAN, 2.0, 3.0, networks=4, pessimism=0.5).double()
    steps = TensorDict(observation=torch.randn(6, 3).double(), batch_size=[6])

    def value():
        torch.manual_seed(1)
        return loss.actor_losses(steps)["loss_actor"]

    with torch.no_grad():
        torch.manual_seed(1)
        dist = loss.actor_network.get_dist(steps)
        action = dist.rsample()
        inputs = steps.clone().set("action", action)
        reward = loss.qvalue_network(inputs)["state_action_value"].min(0).values.squeeze(-1)
        raw = loss.cost_qvalue_network(inputs)["cost_value"].numpy()
        tails = raw[:2] + gaussian_tail(0.3) * np.sqrt(np.log1p(np.exp(raw[2:])))
        charged = (np.mean(tails, 0) + 0.5 * np.std(tails, 0)) @ [2.0, 3.0]
        expected = 0.2 * dist.log_prob(action) - reward + torch.tensor(charged)
    torch.testing.assert_close(value(), expected.mean() / 6)
    assert_gradients_are_differences(value, loss.actor_network_params)


@pytest.mark.parametrize(("lowest", "later"), [(None, 3.0), (4.0, 4.0)])
def test_means_bootstrap_on_the_larger_of_two_and_never_on_less_than_can_be(lowest, later):
    bounds = {"target_pessimism": 1.0, "lowest_cost_value": lowest}
    loss = make_loss_with(GAUSSIAN, 1.0, 1.0, **bounds)
    numbers = torch.tensor([[5.0, 6.0, 1.0, 1.0], [1.0, 3.0, 1.0, 1.0]]).view(2, 4, 1, 1)
    found, following = (loss.cost_values.arranged(each, 1) for each in numbers)
    step = torch.tensor([[6.0]]), torch.tensor([[0.5]])
    errors = loss.cost_values.errors(found.requires_grad_(), *step, following, loss.bounded)
    variance, target = np.log1p(np.e), 6.0 + 0.5 * later
    # the target of the variance, which has the mean in it, does not move the mean
    (slope,) = torch.autograd.grad(errors.sum(), found)
    assert slope[0].flatten().tolist() == pytest.approx([2 * (m - target) for m in (5.0, 6.0)])
    deviation = loss.cost_values.figures(found)["cost_deviation"]
    torch.testing.assert_close(deviation, torch.full((2, 1, 1), variance**0.5))
    for mean, error in zip((5.0, 6.0), errors.flatten().tolist(), strict=True):
        wanted = target**2 + 0.25 * variance - mean**2
        distance = (mean - target) ** 2 + (np.sqrt(variance) - np.sqrt(wanted)) ** 2
        assert error == pytest.approx(distance, rel=1e-5)


def test_a_target_of_a_variance_is_never_below_0():
    """As the second moment of what follows is, below the square of too large a mean."""
    following = torch.tensor([1.0]), torch.tensor([1.0])
    given = torch.tensor([5.0]), torch.tensor([0.0]), torch.tensor([0.5])
    _, variance = GAUSSIAN.moment_targets(*given, following)
    assert 0 < variance < 1e-6


def test_a_variance_that_vanishes_has_a_finite_slope():
    numbers = torch.tensor([[3.0], [-200.0]], requires_grad=True)
    GaussianCosts(tail=0.5).cost(numbers).sum().backward()
    assert numbers.grad.tolist() == [[1.0], [0.0]]


def quantiles(number=10, tail=1.0, huber=1e-3):
    return QuantileCosts(number=number, tail=tail, huber=huber)


def test_quantiles_of_every_cost_and_critic_come_from_one_network():
    values = quantiles(number=4)
    outputs = torch.arange(2 * 3 * 8).reshape(2, 3, 8)  # 2 critics, 3 steps, 2 costs of 4 quantiles
    arranged = values.arranged(outputs, 2)
    assert torch.equal(arranged, outputs.reshape(2, 3, 2, 4).movedim(-1, 0))


@pytest.mark.parametrize(
    ("tail", "expected"), [(1.0, 2.5), (0.5, 3.5), (0.25, 4.0), (0.375, 11 / 3)]
)
def test_the_tail_is_the_mean_of_the_highest_quantiles(tail, expected):
    values, numbers = quantiles(4, tail), torch.tensor([3.0, 1.0, 4.0, 2.0]).unsqueeze(-1)
    torch.testing.assert_close(values.cost(numbers), torch.tensor([expected]))
    deviation = values.figures(numbers)["cost_deviation"]
    torch.testing.assert_close(deviation, torch.tensor([1.25**0.5]))


def test_the_quantile_loss_is_the_equation_of_its_article():
    values = QuantileCosts(number=3, tail=1.0, huber=0.5)
    found, following = torch.randn(2, 3, 2, 5, 2)
    costs, discount = torch.rand(5, 2), torch.full((5, 1), 0.9)
    errors = values.errors(found, costs, discount, following, lambda x: x)
    expected = torch.zeros(2, 5, 2)
    for i, level in enumerate((1 / 6, 1 / 2, 5 / 6)):
        for j in range(3):
            change = costs + 0.9 * following[j] - found[i]
            linear = 0.5 * (change.abs() - 0.25)
            huber = torch.where(change.abs() <= 0.5, change.square() / 2, linear)
            expected += (level - (change < 0).float()).abs() * huber / 0.5 / 3
    torch.testing.assert_close(errors, expected)


def test_quantiles_bootstrap_on_the_larger_of_two_and_never_below_the_bound():
    given = {"target_pessimism": 1.0, "lowest_cost_value": 0.0}
    loss = make_loss_with(quantiles(2), 1.0, 1.0, **given)
    following = torch.tensor([[-1.0, -2.0], [3.0, 5.0]]).reshape(2, 2, 1, 1)
    target = torch.tensor([6.0, 8.5]).reshape(2, 1, 1, 1).expand(2, 2, 1, 1)  # 6 + ½ (0, 5)
    within = torch.tensor([0.0, 5.0]).reshape(2, 1, 1, 1).expand(2, 2, 1, 1)

    def errors(values, later):
        step = torch.tensor([[6.0]]), torch.tensor([[0.5]])
        return loss.cost_values.errors(values, *step, later, loss.bounded)

    found = errors(target, following)
    torch.testing.assert_close(found, errors(target, within))
    assert found.max() < errors(target + 1, following).min()
