"""Comparisons of samples against SciPy, rliable, enumeration and definitions written out.

Figures of rliable (Agarwal et al. 2021) are those of its version 1.2.0 with 20,000 resamples (of
the middle: 50,000). It is no requirement of the tests: with pandas 3 it cannot be imported.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_rl.scores.comparisons import (
    interquartile_mean,
    pareto_front,
    performance_profile,
)
from safe_rl.scores.measures import (
    longest_streak,
    regret,
    share_of_epochs_over,
)


def test_a_profile_is_the_share_of_runs_above():
    strata = [np.random.default_rng(1).normal(size=n) for n in (3, 8)]
    thresholds = np.linspace(-2, 2, 9)
    everything = np.concatenate(strata)
    value, low, high = performance_profile(strata, thresholds)
    for threshold, *found in zip(thresholds, value, low, high, strict=True):
        share = sum(run > threshold for run in everything) / len(everything)
        assert found[0] == pytest.approx(share)
        assert found[1] <= share <= found[2]
    assert (np.diff(value) <= 0).all()


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=9))
def test_the_front_is_what_nobody_beats(points):
    returns, costs = zip(*points, strict=True)
    front = pareto_front(returns, costs).tolist()

    def beats(a, b):
        return a[0] >= b[0] and a[1] <= b[1] and a != b

    unbeaten = {p for p in points if not any(beats(other, p) for other in points)}
    assert {points[i] for i in front} == unbeaten
    assert len(front) == len(unbeaten)
    assert [costs[i] for i in front] == sorted(costs[i] for i in front)


EPOCHS = st.lists(st.integers(0, 4).map(float), min_size=1, max_size=12)


@given(costs=EPOCHS, limit=st.integers(0, 4))
def test_figures_of_the_course_by_counting(costs, limit):
    over = [cost > limit for cost in costs]
    groups = [len(list(group)) for is_over, group in itertools.groupby(over) if is_over]
    assert longest_streak(costs, limit) == max(groups, default=0)
    assert share_of_epochs_over(costs, limit) == pytest.approx(sum(over) / len(over))
    excess = sum(cost - limit for cost in costs if cost > limit)
    assert regret(costs, limit) == pytest.approx(excess / len(costs))


# five runs on three environments
GENERATOR = np.random.default_rng(7)
FIRST = GENERATOR.normal(1.0, 0.4, (5, 3)).round(2).T


def test_the_interquartile_mean_and_its_interval():
    found = interquartile_mean(FIRST)
    assert found.value == pytest.approx(0.93666667)
    # as near as two bootstraps come to each other
    assert (found.low, found.high) == pytest.approx((0.79444444, 1.05333333), abs=0.015)


def test_the_profile_and_its_band():
    share, low, high = performance_profile(FIRST, np.linspace(0.0, 2.0, 9))
    assert share == pytest.approx([1, 1, 1, 11 / 15, 0.4, 1 / 15, 1 / 15, 0, 0])
    # ends are shares of 15 runs; resamples that are as likely as 2.5 % fall on either side
    assert low == pytest.approx([1, 1, 1, 8 / 15, 0.2, 0, 0, 0, 0], abs=1.01 / 15)
    assert high == pytest.approx([1, 1, 1, 14 / 15, 10 / 15, 0.2, 0.2, 0, 0], abs=1.01 / 15)
