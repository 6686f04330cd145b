"""Bounds of means: how often they are wrong, on distributions whose means are known."""

import numpy as np
import pytest

from safe_rl.scores.bounds import betting_bound, log_wealth

LEVEL = 0.95
RNG = np.random.default_rng(1)


def two_point(share, high):
    return lambda shape: high * (RNG.random(shape) < share)


# as episode costs are: counts, many zeros, tails of several times the limit, rare catastrophes
DISTRIBUTIONS = {
    "poisson": (lambda shape: RNG.poisson(25, shape), 25.0, 1000.0),
    "geometric": (lambda shape: RNG.geometric(1 / 25, shape).clip(0, 1000), 25.0, 1000.0),
    "one in 500": (two_point(0.002, 1000.0), 2.0, 1000.0),
    "one in 20": (two_point(0.05, 1.0), 0.05, 1.0),
    "even": (lambda shape: RNG.random(shape), 0.5, 1.0),
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_looked_at_after_every_episode_a_bet_is_won_wrongly_in_one_case_of_twenty(name):
    draw, mean, highest = DISTRIBUTIONS[name]
    won = [log_wealth(draw(1000), mean, highest).max() >= np.log(20) for _ in range(400)]
    # three standard errors of 400 cases above 5 %
    assert np.mean(won) < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 400)


def test_the_wealth_is_what_the_bets_win():
    values, mean, highest = np.array([0.2, 0.9, 0.4]), 0.5, 1.0
    bets, weights = [0.99, 0.7, 0.4, 0.2, 0.08, 0.03], [0.4, 0.2, 0.1, 0.1, 0.1, 0.1]
    wealth = [
        sum(
            weight * np.prod([1 + bet * (mean - value) / (highest - mean) for value in values[:n]])
            for bet, weight in zip(bets, weights, strict=True)
        )
        for n in (1, 2, 3)
    ]
    assert log_wealth(values, mean, highest) == pytest.approx(np.log(wealth))


def test_the_bound_is_where_the_wealth_reaches_what_the_level_asks_for():
    values = RNG.geometric(1 / 20, 900).astype(float).clip(0, 1000)
    bound = betting_bound(values, LEVEL, 1000.0)
    assert log_wealth(values, bound, 1000.0)[-1] == pytest.approx(np.log(20), abs=1e-4)
    assert bound > betting_bound(values, 0.9, 1000.0) > values.mean()


def test_the_bound_of_rare_events_is_little_above_the_exact_one():
    exact = 1 - 0.05 ** (1 / 600)
    assert exact < betting_bound(np.zeros(600), LEVEL, 1.0) < 1.5 * exact


@pytest.mark.parametrize(("odd", "highest"), [(np.nan, 50.0), (np.inf, 50.0), (51.0, 50.0)])
def test_values_that_cannot_be_have_no_bound(odd, highest):
    assert betting_bound([1.0] * 99 + [odd], LEVEL, highest) == np.inf


def test_a_highest_value_has_to_be_known():
    with pytest.raises(ValueError, match="must be finite"):
        betting_bound([1.0], LEVEL, np.inf)
    assert betting_bound([], LEVEL, 3.0) == betting_bound([3.0, 3.0], LEVEL, 3.0) == 3.0
