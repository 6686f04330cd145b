"""J_c from batches: against episodes whose costs are known by construction."""

import pytest
import torch

from safe_rl.objectives.episode_costs import (
    CostEstimate,
    EpisodeCosts,
    EpisodeLengths,
    rate_estimate,
    shrink,
)


def renewals(rows: int, steps: int, generator: torch.Generator):
    """Rows of episodes of 10 steps at cost 2 or 40 steps at cost 20, drawn with equal chance.

    Length and cost depend on each other: E[C] = 11, while the mean of C / length is .35 and
    rate times 25 steps is 11 by the renewal theorem alone. Rows begin in the middle of episodes.
    """
    costs, lengths = torch.zeros(rows, steps, 1), []
    for row in range(rows):
        step = -int(torch.randint(40, (), generator=generator))
        while step < steps:
            length, rate = ((10, 0.2), (40, 0.5))[int(torch.randint(2, (), generator=generator))]
            costs[row, max(step, 0) : max(step + length, 0)] = rate
            step += length
            if 0 <= step <= steps:
                lengths.append(float(length))
    return costs, torch.tensor(lengths)


def test_rate_times_length_is_the_mean_cost_though_length_and_cost_are_correlated():
    generator = torch.Generator().manual_seed(0)
    estimator = EpisodeCosts(1, max_length=40, drift=None, decay=0.99)
    estimates = []
    for _ in range(60):
        costs, lengths = renewals(20, 200, generator)
        estimates.append(estimator.update(costs, lengths).mean)
    assert torch.stack(estimates[20:]).mean() == pytest.approx(11, rel=0.03)


def test_a_batch_of_whole_episodes_gives_their_mean_cost_whatever_their_lengths():
    costs = torch.rand(3, 12, 2)
    estimator = EpisodeCosts(2, max_length=100, drift=None, decay=0.0)
    lengths = torch.tensor([4.0, 8.0, 12.0, 6.0, 6.0])
    estimate = estimator.update(costs, lengths)
    torch.testing.assert_close(estimate.mean, costs.sum((0, 1)) / 5)
    assert estimator.lengths.mean == pytest.approx(7.2)


def steps_of_a_policy(mean_lengths: list[float], rows: int, steps: int, longest: int = 1000):
    """Ends of episodes, batch by batch, of rows that fall with a chance of 1 / L per step."""
    generator = torch.Generator().manual_seed(5)
    age = torch.zeros(rows)
    for mean in mean_lengths:
        ended = []
        for _ in range(steps):
            age += 1
            over = (torch.rand(rows, generator=generator) < 1 / mean) | (age >= longest)
            ended.append(age[over])
            age[over] = 0
        yield torch.cat(ended)


def test_the_length_follows_episodes_that_grow_longer_and_shorter_again():
    rows, steps = 100, 200
    # from 50 to 820 steps of at most 1000 within forty batches, as of robots that learn to walk
    growing = [50 * 50 ** (index / 40) for index in range(41)]
    falls = [*growing, *[2500.0] * 10, *reversed(growing)]
    truth = torch.tensor(falls) * (1 - (1 - 1 / torch.tensor(falls)) ** 1000)
    estimator = EpisodeCosts(1, max_length=1000, drift=None, decay=0.9)
    found = []
    for ended in steps_of_a_policy(falls, rows, steps):
        estimator.update(torch.full((rows, steps, 1), 0.05), ended)
        found.append(estimator.lengths.mean)
    error = (torch.stack(found) / truth).log()
    growth, shrinkage = error[:41], error[-41:]
    assert error.abs().mean() < 0.1
    # nor is it low as long as episodes grow, where a limit would be broken unseen
    assert growth.mean() > -0.05
    assert shrinkage.mean().abs() < 0.05


def test_the_length_counts_steps_of_batches_without_ends_and_the_last_hundred_ends():
    one_row, changed = EpisodeLengths(100), EpisodeLengths(100)
    for batch in range(50):  # of 10 steps, in episodes of 25
        ends = (batch + 1) * 10 // 25 - batch * 10 // 25
        one_row.update(10, torch.full((ends,), 25.0))
    for steps, ends in [(50, 10)] * 20 + [(100, 50)] * 2:
        changed.update(steps, torch.full((ends,), steps / ends))
    cut_off = EpisodeLengths(100)
    cut_off.update(500, torch.tensor([40.0]))  # the other rows have not ended yet
    assert (one_row.mean, changed.mean, cut_off.mean) == (25, 2, 100)


@pytest.mark.parametrize(("rows", "steps"), [(30, 200), (4, 1000), (7, 130)])
def test_where_all_episodes_have_one_length_it_is_exact(rows, steps):
    estimator = EpisodeCosts(1, max_length=1000, drift=None, decay=0.9)
    starts = torch.arange(rows) * 991 % 1000
    for batch in range(60):
        ages = starts + batch * steps
        number = int(((ages + steps) // 1000 - ages // 1000).sum())
        estimator.update(torch.zeros(rows, steps, 1), torch.full((number,), 1000.0))
        assert estimator.lengths.mean == 1000


@pytest.mark.parametrize(("rows", "alike"), [(1, 1), (2, 1), (50, 1), (50, 40)])
def test_the_standard_error_is_that_of_the_mean_over_many_batches(rows, alike):
    """Of steps of which so many on end are alike."""
    torch.manual_seed(rows)
    batches = (torch.rand(4000, rows, 40 // alike, 1) < 0.1).float().repeat_interleave(alike, 2)
    estimates = [rate_estimate(batch, torch.tensor(100.0)) for batch in batches]
    means = torch.stack([estimate.mean for estimate in estimates])
    errors = torch.stack([estimate.error for estimate in estimates])
    assert errors.square().mean().sqrt() == pytest.approx(means.std().item(), rel=0.1)


def test_shrinkage_predicts_a_wandering_cost_better_than_the_batch_and_than_the_past():
    generator = torch.Generator().manual_seed(1)
    truth = torch.tensor([50.0])
    estimate = CostEstimate(*torch.full((2, 1), torch.nan))
    squared = {"shrunk": 0.0, "batch": 0.0, "mean of all": 0.0}
    total = torch.zeros(1)
    for number in range(1, 4001):
        truth = truth + 3 * torch.randn(1, generator=generator)
        noisy = truth + 6 * torch.randn(1, generator=generator)
        total += noisy
        estimate = shrink(estimate, CostEstimate(noisy, torch.tensor([6.0])), torch.tensor([3.0]))
        squared["shrunk"] += (estimate.mean - truth).square().item()
        squared["batch"] += (noisy - truth).square().item()
        squared["mean of all"] += (total / number - truth).square().item()
    assert squared["shrunk"] < 0.6 * min(squared["batch"], squared["mean of all"])
    assert estimate.error.square().item() == pytest.approx(squared["shrunk"] / 4000, rel=0.15)
    exact = (CostEstimate(torch.tensor([cost]), torch.zeros(1)) for cost in (5.0, 7.0))
    assert shrink(*exact, torch.zeros(1)).mean == 7


def heaps(generator: torch.Generator, per_step: float = 0.001, size: float = 25.0):
    """Rows of 200 steps with costs as robots pay them: rarely, and then many steps on end."""
    begun = torch.rand(100, 200, generator=generator) < per_step
    costs = torch.zeros(100, 200)
    for row, step in begun.nonzero().tolist():
        length = 1 + int(torch.empty(()).exponential_(1 / size, generator=generator))
        costs[row, step : step + length] = 1.0
    return costs.unsqueeze(-1)


def test_costs_that_come_in_heaps_are_not_underestimated():
    # a batch with few heaps shows a small standard error; weighed by it, estimates were 10 % low
    generator = torch.Generator().manual_seed(2)
    estimator = EpisodeCosts(1, max_length=1000, drift=0.2, decay=0.9, smallest=0.01)
    estimates, batches = [], []
    for _ in range(400):
        estimates.append(estimator.update(heaps(generator), torch.empty(0)).mean)
        batches.append(estimator.batch.mean)
    estimate, truth = (torch.stack(values[20:]).mean().item() for values in (estimates, batches))
    assert estimate == pytest.approx(truth, rel=0.02)


def test_the_unit_of_a_cost_is_1_for_indicators_and_grows_with_the_cost():
    costs = (torch.rand(4, 50, 1) < 0.2).float() * torch.tensor([1.0, 7.0])
    estimator = EpisodeCosts(2, max_length=50, drift=0.1, decay=0.9)
    assert estimator.unit.tolist() == [1.0, 1.0]
    for given in (costs, 0 * costs):
        estimator.update(given, torch.empty(0))
    assert estimator.unit.tolist() == [1.0, 7.0]
