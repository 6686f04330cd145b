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


def test_a_batch_of_whole_episodes_gives_their_mean_cost_whatever_their_lengths():
    costs = torch.rand(3, 12, 2)
    estimator = EpisodeCosts(2, max_length=100, drift=None, decay=0.0)
    lengths = torch.tensor([4.0, 8.0, 12.0, 6.0, 6.0])
    estimate = estimator.update(costs, lengths)
    torch.testing.assert_close(estimate.mean, costs.sum((0, 1)) / 5)
    assert estimator.lengths.mean == pytest.approx(7.2)


@pytest.mark.parametrize(
    ("batches", "mean"),
    [
        # of 10 steps, in episodes of 25
        ([(10, (number + 1) * 10 // 25 - number * 10 // 25) for number in range(50)], 25),
        # the last hundred ends, and all steps since the ends before them
        ([(50, 10)] * 20 + [(100, 50), (300, 50)], 4),
        ([(100, 50), (100, 0), (100, 0), (100, 100)], 3),
        # the other rows have not ended yet
        ([(500, 1)], 100),
    ],
)
def test_the_length_counts_steps_of_batches_without_ends_and_the_last_hundred_ends(batches, mean):
    lengths = EpisodeLengths(100)
    for steps, ends in batches:
        lengths.update(steps, torch.full((ends,), 25.0))
    assert lengths.mean == mean


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


@pytest.mark.parametrize(
    ("past", "present", "drift", "expected"),
    [
        # (4² + 3²) / (4² + 3² + 6²) is the share of the batch
        ((50.0, 4.0), (60.0, 6.0), 3.0, (50 + 10 * 25 / 61, (36 * 25 / 61) ** 0.5)),
        ((torch.nan, torch.nan), (60.0, 6.0), 3.0, (60.0, 6.0)),
        ((5.0, 0.0), (7.0, 0.0), 0.0, (7.0, 0.0)),
    ],
)
def test_shrinkage_is_a_step_of_kalmans_filter(past, present, drift, expected):
    given = (CostEstimate(*torch.tensor(each).unsqueeze(-1)) for each in (past, present))
    found = shrink(*given, torch.tensor([drift]))
    assert (found.mean.item(), found.error.item()) == pytest.approx(expected)


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
