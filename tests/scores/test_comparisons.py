"""Estimates and comparisons against closed forms, enumeration, linear programming and rliable.

Figures of rliable (Agarwal et al. 2021) are those of its version 1.2.0 with 20,000 resamples (of
the middle: 50,000). It is no requirement of the tests: with pandas 3 it cannot be imported.
"""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from safe_rl.scores import comparisons


def test_the_interval_of_a_mean_is_the_normal_one_for_many_values():
    values = np.random.default_rng(1).normal(3.0, 2.0, size=2000)
    estimate = comparisons.mean(values)
    half_width = 1.96 * values.std(ddof=1) / math.sqrt(len(values))
    assert estimate.value == pytest.approx(values.mean())
    assert estimate.low == pytest.approx(values.mean() - half_width, abs=0.1 * half_width)
    assert estimate.high == pytest.approx(values.mean() + half_width, abs=0.1 * half_width)


def test_strata_are_resampled_apart():
    # every resample of 2 + 2 values, equally likely: the exact bootstrap distribution
    strata = [[0.0, 10.0], [100.0, 140.0]]
    draws = itertools.product(*(itertools.product(s, repeat=len(s)) for s in strata))
    outcomes = np.array([np.mean([x for part in draw for x in part]) for draw in draws])
    assert len(outcomes) == 16

    def overall(*samples, axis):
        return np.concatenate(samples, axis=axis).mean(axis)

    low, high = comparisons.bootstrap(strata, overall)
    assert (low, high) == (outcomes.min(), outcomes.max())
    # of a single value nobody knows how far others would be
    assert np.isnan(comparisons.bootstrap([*strata, [7.0]], overall)).all()
    assert comparisons.mean([4.0, 4.0, 4.0]) == (4.0, 4.0, 4.0)


def test_what_is_no_number_has_no_interval_and_no_warning(recwarn):
    assert np.isnan(comparisons.mean([1.0, math.nan, 2.0])).all()
    assert np.isnan(comparisons.interquartile_mean([[1.0, math.nan], [2.0, 3.0]])).all()
    assert np.isnan(comparisons.mean([1.0, math.inf, 2.0])[1:]).all()
    assert not recwarn.list


def test_many_curves_at_once_are_many_curves():
    values = np.random.default_rng(2).normal(size=(5, 3))
    low, high = comparisons.bootstrap([values], np.mean)
    # with three seeds the same one is drawn thrice in 1 of 27 cases, which is more than 2.5 %
    np.testing.assert_allclose(low, values.min(-1))
    np.testing.assert_allclose(high, values.max(-1))


def test_the_same_samples_give_the_same_interval_in_portions_of_any_size(monkeypatch):
    values = np.random.default_rng(3).normal(size=50)
    first = comparisons.mean(values)
    assert comparisons.mean(values) == first
    monkeypatch.setattr(comparisons, "_PORTION", 10)  # fewer numbers than one resample has
    assert comparisons.mean(values) == pytest.approx(first)


def test_students_interval_of_every_row(recwarn):
    values = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 30.0]])
    # with two degrees of freedom the quantile is 4.302653; variances are 1 and 300
    centre, reach = np.array([2.0, 10.0]), 4.302653 * np.sqrt([1 / 3, 100])
    low, high = comparisons.t_interval(values)
    np.testing.assert_allclose(low, centre - reach, rtol=1e-6)
    np.testing.assert_allclose(high, centre + reach, rtol=1e-6)
    assert np.isnan(comparisons.t_interval([[1.0], [2.0]])).all()
    assert not recwarn.list


@pytest.mark.parametrize("alpha", [0.1, 0.37, 1.0])
def test_cvar_solves_the_program_of_rockafellar_and_uryasev(alpha):
    values = np.random.default_rng(5).exponential(10.0, size=23)
    # minimise t + sum(z) / (alpha n) over t and z >= max(0, value - t)
    number = len(values)
    solution = linprog(
        c=np.concatenate([[1.0], np.full(number, 1 / (alpha * number))]),
        A_ub=np.hstack([-np.ones((number, 1)), -np.eye(number)]),
        b_ub=-values,
        bounds=[(None, None)] + [(0, None)] * number,
    )
    estimate = comparisons.cvar(values, alpha)
    assert estimate.value == pytest.approx(solution.fun)
    assert estimate.low <= estimate.value <= estimate.high


@pytest.mark.parametrize("alpha", [0.0, 1.1, math.nan])
def test_a_tail_is_a_share_of_the_values(alpha):
    with pytest.raises(ValueError, match="must be a share of episodes"):
        comparisons.cvar([1.0, 2.0], alpha)


def test_the_interval_of_a_share_is_wilsons():
    values = [0.0] * 16 + [30.0] * 4
    over, total, z = 4, 20, 1.959964
    centre = (over + z**2 / 2) / (total + z**2)
    half = z / (total + z**2) * math.sqrt(over * (total - over) / total + z**2 / 4)
    estimate = comparisons.share_over(values, 25.0)
    assert estimate == pytest.approx((0.2, centre - half, centre + half), rel=1e-5)
    assert [comparisons.share_over([25.0, cost], 25.0).value for cost in (25.0, math.nan)] == [
        0.0,
        0.5,
    ]


# five runs on three environments
GENERATOR = np.random.default_rng(7)
FIRST = GENERATOR.normal(1.0, 0.4, (5, 3)).round(2).T


def test_the_interquartile_mean_and_its_interval():
    found = comparisons.interquartile_mean(FIRST)
    assert found.value == pytest.approx(0.93666667)
    # as near as two bootstraps come to each other
    assert (found.low, found.high) == pytest.approx((0.79444444, 1.05333333), abs=0.015)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=9))
def test_the_front_is_what_nobody_beats(points):
    returns, costs = zip(*points, strict=True)
    front = comparisons.pareto_front(returns, costs).tolist()
    # the last agent has not finished an episode
    assert comparisons.pareto_front([*returns, math.nan], [*costs, -1.0]).tolist() == front

    def beats(a, b):
        return a[0] >= b[0] and a[1] <= b[1] and a != b

    unbeaten = {p for p in points if not any(beats(other, p) for other in points)}
    assert {points[i] for i in front} == unbeaten
    assert len(front) == len(unbeaten)
    assert [costs[i] for i in front] == sorted(costs[i] for i in front)
