"""Comparisons of samples against SciPy, rliable, enumeration and definitions written out.

Figures of rliable (Agarwal et al. 2021) are those of its version 1.2.0 with 20,000 resamples (of
the middle: 50,000). It is no requirement of the tests: with pandas 3 it cannot be imported.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from safe_rl.scores.comparisons import interquartile_mean, pareto_front
from safe_rl.scores.measures import learning_cost


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
    excess = sum(cost - limit for cost in costs if cost > limit)
    expected = {"streak": max(groups, default=0), "share_over": sum(over) / len(over)}
    assert learning_cost(costs, limit) == pytest.approx(expected | {"regret": excess / len(over)})


# five runs on three environments
GENERATOR = np.random.default_rng(7)
FIRST = GENERATOR.normal(1.0, 0.4, (5, 3)).round(2).T


def test_the_interquartile_mean_and_its_interval():
    found = interquartile_mean(FIRST)
    assert found.value == pytest.approx(0.93666667)
    # as near as two bootstraps come to each other
    assert (found.low, found.high) == pytest.approx((0.79444444, 1.05333333), abs=0.015)
