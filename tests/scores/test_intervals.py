"""Estimates against closed forms, enumeration and linear programming."""

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import linprog

from safe_rl.scores.comparisons import bootstrap, cvar, interquartile_mean, mean, share_over


def test_the_interval_of_a_mean_is_the_normal_one_for_many_values():
    values = np.random.default_rng(1).normal(3.0, 2.0, size=2000)
    estimate = mean(values)
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

    low, high = bootstrap(strata, overall)
    assert (low, high) == (outcomes.min(), outcomes.max())
    # of a single value nobody knows how far others would be
    assert np.isnan(bootstrap([*strata, [7.0]], overall)).all()
    assert mean([4.0, 4.0, 4.0]) == (4.0, 4.0, 4.0)


def test_what_is_no_number_has_no_interval_and_no_warning(recwarn):
    assert np.isnan(mean([1.0, math.nan, 2.0])).all()
    assert np.isnan(interquartile_mean([[1.0, math.nan], [2.0, 3.0]])).all()
    assert not recwarn.list


def test_many_curves_at_once_are_many_curves():
    values = np.random.default_rng(2).normal(size=(5, 3))
    low, high = bootstrap([values], np.mean)
    # with three seeds the same one is drawn thrice in 1 of 27 cases, which is more than 2.5 %
    np.testing.assert_allclose(low, values.min(-1))
    np.testing.assert_allclose(high, values.max(-1))


def test_the_interquartile_mean_leaves_a_quarter_out_at_each_end():
    values = np.random.default_rng(4).normal(size=40)
    middle = np.sort(values)[10:30].mean()
    estimate = interquartile_mean([values[:13], values[13:]])
    assert estimate.value == pytest.approx(middle)
    assert estimate.low < middle < estimate.high


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
    estimate = cvar(values, alpha)
    assert estimate.value == pytest.approx(solution.fun)
    assert estimate.low <= estimate.value <= estimate.high


def test_the_interval_of_a_share_is_wilsons():
    values = [0.0] * 16 + [30.0] * 4
    over, total, z = 4, 20, 1.959964
    centre = (over + z**2 / 2) / (total + z**2)
    half = z / (total + z**2) * math.sqrt(over * (total - over) / total + z**2 / 4)
    estimate = share_over(values, 25.0)
    assert estimate == pytest.approx((0.2, centre - half, centre + half), rel=1e-5)
    assert share_over([25.0, 25.0], 25.0).value == 0.0
