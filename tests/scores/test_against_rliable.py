"""The statistics of Agarwal et al. (2021) against the authors' own library.

The figures are those of rliable 1.2.0 with 20,000 resamples (of the middle: 50,000). It is no
requirement of the tests: with it come pandas, seaborn and statsmodels, and with pandas 3 it cannot
be imported.
"""

import numpy as np
import pytest

from safe_rl.scores.comparisons import (
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
)

# five runs of two algorithms on three environments
GENERATOR = np.random.default_rng(7)
FIRST = GENERATOR.normal(1.0, 0.4, (5, 3)).round(2).T
SECOND = GENERATOR.normal(0.8, 0.5, (5, 3)).round(2).T


def test_the_interquartile_mean_and_its_interval():
    found = interquartile_mean(FIRST)
    assert found.value == pytest.approx(0.93666667)
    # as near as two bootstraps come to each other
    assert (found.low, found.high) == pytest.approx((0.79444444, 1.05333333), abs=0.015)


def test_the_probability_of_improvement_and_its_interval():
    found = probability_of_improvement(FIRST, SECOND)
    assert found.value == pytest.approx(0.8)
    assert (found.low, found.high) == pytest.approx((0.61333333, 0.94666667), abs=0.02)


def test_the_profile_and_its_band():
    share, low, high = performance_profile(FIRST, np.linspace(0.0, 2.0, 9))
    assert share == pytest.approx([1, 1, 1, 11 / 15, 0.4, 1 / 15, 1 / 15, 0, 0])
    # ends are shares of 15 runs; resamples that are as likely as 2.5 % fall on either side
    assert low == pytest.approx([1, 1, 1, 8 / 15, 0.2, 0, 0, 0, 0], abs=1.01 / 15)
    assert high == pytest.approx([1, 1, 1, 14 / 15, 10 / 15, 0.2, 0.2, 0, 0], abs=1.01 / 15)
