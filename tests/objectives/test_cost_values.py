"""Critics of Gaussian and quantile costs against closed forms, samples and finite differences."""

import numpy as np
import pytest
import torch
from samples import assert_gradients_are_differences, limit_state
from scipy import integrate, stats
from tensordict import TensorDict
from torchrl.data import Bounded

from safe_rl.models import QEnsemble, make_squashed_actor
from safe_rl.objectives import GaussianCosts, LagrangeMultiplier, QuantileCosts, SACLagrangianLoss
from safe_rl.objectives.cost_values import gaussian_tail

BOUNDS = -torch.ones(2), torch.ones(2)
SETTINGS = {"gamma": 0.9, "alpha_init": 0.2, "action_spec": Bounded(-1, 1, [2])}


def make_loss(observed=3, hidden=(8,), networks=2, costs=("cost",), values=None, **keys):
    values = GaussianCosts(tail=0.3) if values is None else values
    outputs = {"num_outputs": len(costs) * values.outputs, "out_key": "costs"}
    q = [
        QEnsemble(observed, 2, hidden_sizes=hidden, num_networks=number, **more)
        for number, more in ((2, {}), (networks, outputs))
    ]
    multiplier = LagrangeMultiplier(dict.fromkeys(costs, 25.0), init=2.0, lr=0.05)
    loss = SACLagrangianLoss(
        make_squashed_actor(observed, *BOUNDS, hidden_sizes=[8]), *q,
        multiplier=multiplier, cost_keys=costs, cost_values=values, **SETTINGS, **keys,
    )  # fmt: skip
    nothing = TensorDict({"next": {"reward": torch.empty(0, 1)}}, [0])
    loss.prepare(nothing, limit_state(*[0.0] * len(costs)))
    return loss


def make_steps(observations, following, costs, terminated):
    size = len(observations)
    after = {
        "observation": following, "cost": costs.reshape(size, 1), "reward": torch.zeros(size, 1),
        "done": terminated.reshape(size, 1), "terminated": terminated.reshape(size, 1),
    }  # fmt: skip
    return TensorDict(
        observation=observations, action=torch.zeros(size, 2), next=after, batch_size=[size]
    )


@pytest.mark.parametrize("tail", [0.01, 0.1, 0.5, 0.9, 1.0])
def test_the_tail_is_the_mean_beyond_the_quantile(tail):
    beyond = stats.norm.isf(tail)
    mean = integrate.quad(lambda x: x * stats.norm.pdf(x), beyond, np.inf)[0] / tail
    assert gaussian_tail(tail) == pytest.approx(mean, rel=1e-6)


def test_a_chain_is_learned_to_the_mean_and_variance_of_its_gaussian_return():
    """Four steps of known costs; then a return that is normal with 3 and 0.8²."""
    costs, gamma = torch.tensor([1.0, 0.0, 2.0, 0.5]), 0.9
    loss = make_loss(5, hidden=())  # a table: linear in the number of the state
    states = torch.eye(5)
    steps = make_steps(states[:4], states[1:], costs, torch.zeros(4, dtype=torch.bool))
    (layer, bias), (target, target_bias) = (
        (params["network", "weights", "0"], params["network", "biases", "0"].data.zero_())
        for params in (loss.cost_qvalue_network_params, loss.target_cost_qvalue_network_params)
    )
    layer.data[:, 4] = torch.tensor([[3.0], [0.64 + np.log(-np.expm1(-0.64))]])  # softplus 0.64
    optimizer = torch.optim.Adam([layer], lr=0.05)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.998)
    for _ in range(2000):
        target.data.copy_(layer.data)
        optimizer.zero_grad()
        loss.cost_qvalue_loss(steps, torch.zeros(4, 2)).backward()
        layer.grad[:, 4] = 0
        optimizer.step()
        schedule.step()
    assert not torch.cat([bias, target_bias]).any()
    values = loss.values_of_costs(steps, steps["action"])
    mean, variance = (part[0, :, 0].detach() for part in loss.cost_values.moments(values))
    left = np.arange(4, 0, -1)
    expected = [
        sum(gamma**i * c for i, c in enumerate(costs[s:].tolist())) + gamma**n * 3.0
        for s, n in enumerate(left)
    ]
    torch.testing.assert_close(mean, torch.tensor(expected).float(), atol=2e-3, rtol=0)
    deviation = torch.tensor(0.8 * gamma**left).float()
    torch.testing.assert_close(variance.sqrt(), deviation, atol=5e-3, rtol=0)


def test_targets_of_the_variance_are_right_on_average_over_costs_and_successors():
    """Against a million sampled returns: costs 0 or 1, then one of two normal returns."""
    rng = np.random.default_rng(0)
    cost, which = rng.integers(0, 2, (2, 1_000_000))
    means, deviations, discount = np.array([2.0, 5.0]), np.array([0.5, 1.5]), 0.81
    returns = cost + discount * rng.normal(means[which], deviations[which])
    following = [torch.tensor(value[which]).reshape(1, -1, 1) for value in (means, deviations**2)]
    target, variance = GaussianCosts(tail=0.3).moment_targets(
        torch.tensor(returns.mean()).expand(1, len(which), 1),
        torch.tensor(cost).reshape(-1, 1).double(),
        torch.tensor([discount]).double(),
        following,
    )
    assert target.mean().item() == pytest.approx(returns.mean(), rel=2e-3)
    # targets below 0 are cut, of which there are none if the mean's square exceeds no second moment
    floor = 1e-8
    cut = (variance <= floor).double().mean().item()
    unbiased = target.square() + discount**2 * following[1] - returns.mean() ** 2
    assert 0 < cut < 0.6
    torch.testing.assert_close(variance, unbiased.clamp_min(floor))
    assert unbiased.mean().item() == pytest.approx(returns.var(), rel=5e-3)


def test_the_actor_pays_the_tail_and_its_gradient_is_that_of_finite_differences():
    loss = make_loss(networks=4, pessimism=0.5).double()
    steps = make_steps(
        torch.randn(6, 3), torch.randn(6, 3), torch.rand(6), torch.zeros(6, dtype=torch.bool)
    ).double()

    def value():
        torch.manual_seed(1)
        return loss.actor_losses(steps)["loss_actor"]

    with torch.no_grad():
        torch.manual_seed(1)
        dist = loss.actor_network.get_dist(steps)
        action = dist.rsample()
        inputs = steps.clone().set("action", action)
        reward = loss.qvalue_network(inputs)["state_action_value"].min(0).values.squeeze(-1)
        raw = loss.cost_qvalue_network(inputs)["costs"].squeeze(-1).numpy()
        mean, deviation = raw[:2], np.sqrt(np.log1p(np.exp(raw[2:])))
        tails = [
            [
                stats.norm.expect(lambda x: x, loc=m, scale=s, lb=stats.norm.isf(0.3, m, s)) / 0.3
                for m, s in zip(*row, strict=True)
            ]
            for row in zip(mean, deviation, strict=True)
        ]
        charged = np.mean(tails, 0) + 0.5 * np.std(tails, 0)
        expected = 0.2 * dist.log_prob(action) - reward + 2.0 * torch.tensor(charged)
    torch.testing.assert_close(value(), expected.mean() / 3)
    assert_gradients_are_differences(value, loss.actor_network_params)


@pytest.mark.parametrize(("lowest", "later"), [(None, 3.0), (4.0, 4.0)])
def test_means_bootstrap_on_the_larger_of_two_and_never_on_less_than_can_be(lowest, later):
    loss = make_loss(networks=4, target_pessimism=1.0, lowest_cost_value=lowest)
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
    loss = make_loss(values=quantiles(2), **given)
    following = torch.tensor([[-1.0, -2.0], [3.0, 5.0]]).reshape(2, 2, 1, 1)
    target = torch.tensor([6.0, 8.5]).reshape(2, 1, 1, 1).expand(2, 2, 1, 1)  # 6 + ½ (0, 5)
    within = torch.tensor([0.0, 5.0]).reshape(2, 1, 1, 1).expand(2, 2, 1, 1)

    def errors(values, later):
        step = torch.tensor([[6.0]]), torch.tensor([[0.5]])
        return loss.cost_values.errors(values, *step, later, loss.bounded)

    found = errors(target, following)
    torch.testing.assert_close(found, errors(target, within))
    assert found.max() < errors(target + 1, following).min()
