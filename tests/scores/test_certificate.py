"""Certificates: how often they are wrong, on distributions whose means are known."""

import numpy as np
import pytest
from scipy import stats

from safe_rl.scores.certificate import Claim, first_certified, mean_bound, rank, share_bound

LEVEL = 0.95
# as episode costs are: counts, many zeros, tails of several times the limit
DISTRIBUTIONS = {
    "poisson": stats.poisson(25),
    "geometric": stats.geom(1 / 25),
    "gamma": stats.gamma(0.6, scale=25 / 0.6),
    "lognormal": stats.lognorm(0.9, scale=25 / np.exp(0.9**2 / 2)),
    "normal": stats.norm(25, 8),
}


@pytest.mark.parametrize("name", DISTRIBUTIONS)
@pytest.mark.parametrize("number", [100, 250])
def test_bounds_of_means_are_below_them_in_one_case_of_twenty(name, number):
    draws = DISTRIBUTIONS[name].rvs((2000, number), random_state=1)
    wrong = np.mean(mean_bound(draws, LEVEL) < DISTRIBUTIONS[name].mean())
    # three standard errors of the 2000 draws above 5 %
    assert wrong < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 2000)


def test_the_correction_is_for_skewed_costs_only():
    # even, with a tail to the left, with one to the right
    costs = np.array([[10.0, 20.0, 30.0, 40.0], [0.0, 100.0, 100.0, 100.0], [0.0, 0.0, 0.0, 100.0]])
    student = costs.mean(1) + stats.t.ppf(LEVEL, 3) * costs.std(1, ddof=1) / 2
    bounds = mean_bound(costs, LEVEL)
    assert bounds[:2] == pytest.approx(student[:2])
    assert bounds[2] > student[2]


def test_students_bound_alone_would_be_wrong_too_often():
    """What the correction is for: without it, this test's counterpart above fails."""
    gamma = DISTRIBUTIONS["gamma"]
    draws = gamma.rvs((2000, 100), random_state=1)
    errors = draws.std(1, ddof=1) / 10
    wrong = np.mean(draws.mean(1) + stats.t.ppf(LEVEL, 99) * errors < gamma.mean())
    assert wrong > 0.05 + 2 * np.sqrt(0.05 * 0.95 / 2000)


def test_bounds_of_shares_are_those_of_the_exact_test():
    values = np.r_[np.full(37, 30.0), np.full(163, 10.0)]
    exact = stats.binomtest(37, 200).proportion_ci(0.9, method="exact").high
    assert share_bound(values, 25.0, LEVEL) == pytest.approx(exact)
    assert share_bound(np.full(5, 30.0), 25.0, LEVEL) == 1.0


def certify(rng, means, claim, number=250, tests=3, more=0):
    """The whole procedure on policies with geometric costs; `more` are a second test's episodes."""
    draw = lambda mean, n=number: rng.geometric(1 / mean, n).astype(float)  # noqa: E731
    first = [{"cost": draw(mean)} for mean in means]
    returns = [np.full(number, mean) for mean in means]  # who costs more gets more
    order = rank(returns, first, claim)
    collect_more = (lambda k: {"cost": draw(means[k], more)}) if more else None
    return first_certified(order, lambda k: {"cost": draw(means[k])}, claim, tests, collect_more)


@pytest.mark.parametrize("more", [0, 1000])
def test_of_many_policies_above_the_limit_hardly_ever_one_is_certified(more):
    rng, claim = np.random.default_rng(0), Claim({"cost": 25.0}, level=LEVEL)
    verdicts = [certify(rng, [25.1] * 8, claim, more=more) for _ in range(600)]
    assert np.mean([verdict.certified is not None for verdict in verdicts]) < 0.05
    # second tests are had
    assert any(len(verdict.tested) > 3 for verdict in verdicts) is bool(more)


def test_more_episodes_certify_the_policy_that_fell_short_least():
    rng, claim = np.random.default_rng(0), Claim({"cost": 25.0}, level=LEVEL)
    means = [24.9, 22.5, 24.9]
    found = {more: [certify(rng, means, claim, more=more) for _ in range(60)] for more in (0, 2000)}
    certified = {more: [v.certified for v in verdicts] for more, verdicts in found.items()}
    assert certified[0].count(1) < 20
    assert certified[2000].count(1) > 40
    again = next(v for v in found[2000] if v.certified == 1 and len(v.tested) == 4)
    assert again.tested[-1] == 1
    assert again.bounds["mean_cost"][0] < 25


@pytest.mark.parametrize(
    ("costs", "most_over"),
    [
        ([20.0, 31.0], 1.0),
        ([25.0, 25.0], 1.0),  # as those of a limit of 0 that is kept
        ([0.0, 0.0, 30.0], 0.2),
        ([np.nan, 1.0], 1.0),
    ],
)
def test_no_more_episodes_are_had_where_those_so_far_break_the_limit(costs, most_over):
    def collect_more(candidate):
        raise AssertionError(f"{candidate} is not to be tested again")

    claim = Claim({"cost": 25.0}, most_over=most_over)
    verdict = first_certified([0], lambda _: {"cost": costs}, claim, 1, collect_more)
    assert verdict.certified is None
    assert verdict.tested == [0]


def test_all_tests_share_the_error_the_second_one_too():
    costs = {"cost": np.tile([10.0, 30.0], 5)}
    claim = Claim({"cost": 25.0})
    verdict = first_certified([0], lambda _: costs, claim, 1, lambda _: costs)
    assert verdict.tested == [0, 0]
    assert verdict.bounds["mean_cost"][0] == float(mean_bound(costs["cost"], 1 - 0.05 / 2))


@pytest.mark.parametrize(("most_over", "bounds"), [(1.0, 6), (0.3, 12)])
def test_the_error_is_shared_out_among_all_bounds_of_all_tests(most_over, bounds):
    costs = {"cost": np.arange(50.0), "cost_hazards": np.arange(50.0) % 7}
    limits = {"cost": 25.0, "cost_hazards": 5.0}
    found = Claim(limits, most_over=most_over, level=0.9).bounds(costs, tests=3)
    level = 1 - 0.1 / bounds
    expected = {f"mean_{key}": float(mean_bound(costs[key], level)) for key in limits}
    if most_over < 1:
        for key, limit in limits.items():
            expected[f"over_limit_{key}"] = share_bound(costs[key], limit, level)
    assert {name: bound for name, (bound, _) in found.items()} == pytest.approx(expected)


def test_candidates_go_in_the_order_of_what_the_tests_will_ask_for():
    rng, claim = np.random.default_rng(0), Claim({"cost": 100.0, "cost_hazards": 5.0})
    means = [(99.0, 4.0), (90.0, 4.0), (110.0, 4.0), (90.0, 7.0)]
    costs = [
        {"cost": np.full(50, first), "cost_hazards": np.full(50, second)} for first, second in means
    ]
    # on average within its limit, but not by enough standard errors
    costs[0]["cost"] += 20 * stats.zscore(rng.normal(size=50))
    # then a tenth of a limit too much, and two fifths of another one
    assert rank([[9.0], [5.0], [9.0], [9.0]], costs, claim) == [1, 0, 2, 3]


def test_the_best_policy_that_keeps_the_limit_is_named():
    rng, claim = np.random.default_rng(0), Claim({"cost": 25.0}, level=LEVEL)
    found = [certify(rng, [10.0, 16.0, 24.8, 40.0], claim).certified for _ in range(100)]
    assert found.count(1) > 90
    assert 3 not in found


def test_none_is_named_where_none_keeps_the_limit_and_by_how_much():
    rng, claim = np.random.default_rng(0), Claim({"cost": 25.0}, level=LEVEL)
    verdict = certify(rng, [40.0, 32.0, 60.0], claim)
    assert verdict.certified is None
    assert verdict.tested[0] == 1
    assert 5 < verdict.shortfalls["mean_cost"] < 15


def test_bounds_and_shortfalls_are_those_of_the_policy_that_fell_short_least():
    costs = [np.tile([mean - 1e-6, mean + 1e-6], 25) for mean in (30.0, 27.0, 45.0)]
    verdict = first_certified(
        [0, 1, 2], lambda k: {"cost": costs[k]}, Claim({"cost": 25.0}), tests=3
    )
    assert verdict.tested == [0, 1, 2]
    assert verdict.bounds == {"mean_cost": (pytest.approx(27.0), 25.0)}
    assert verdict.shortfalls == {"mean_cost": pytest.approx(2.0)}


def test_nothing_tested_is_nothing_certified():
    assert first_certified([], dict, Claim({"cost": 25.0}), tests=3).certified is None


def test_shares_of_episodes_can_be_asked_for():
    costs = {"cost": np.r_[np.zeros(150), np.full(100, 30.0)]}  # mean 12, two fifths over 25
    assert not Claim({"cost": 25.0}).shortfalls(costs, tests=1)
    assert list(Claim({"cost": 25.0}, most_over=0.3).shortfalls(costs, tests=1)) == [
        "over_limit_cost"
    ]
    assert not Claim({"cost": 25.0}, most_over=0.5).shortfalls(costs, tests=1)


def test_every_limit_has_to_be_kept():
    costs = {"cost": np.full(50, 10.0), "cost_hazards": np.full(50, 6.0)}
    claim = Claim({"cost": 25.0, "cost_hazards": 5.0}, largest={"cost": 20.0, "cost_hazards": 6.0})
    assert claim.shortfalls(costs, tests=1) == {"mean_cost_hazards": pytest.approx(1.0)}


@pytest.mark.parametrize("number", [20, 100, 600])
@pytest.mark.parametrize("expected", [0.2, 1.0, 2.7, 4.0])
def test_costs_that_are_rare_keep_the_level(number, expected):
    """Of a policy that costs 100 in a few episodes of so many, often nothing but 0 is seen."""
    share = expected / number
    draws = 100.0 * (np.random.default_rng(0).random((2000, number)) < share)
    assert np.mean(mean_bound(draws, LEVEL, largest=100.0) < 100.0 * share) < 1 - LEVEL


def test_the_bound_of_what_was_not_seen_is_the_exact_one():
    exact = stats.binomtest(0, 30).proportion_ci(0.9, method="exact").high
    assert mean_bound(np.full(30, 4.0), LEVEL, largest=50.0) == pytest.approx(4 + exact * 46)
    assert mean_bound(np.zeros(30), LEVEL) == np.inf
    # rows of a table are judged one by one
    both = mean_bound([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]], LEVEL, largest=1.0)
    assert both[1] == mean_bound([1.0, 2.0, 3.0], LEVEL)


def test_a_limit_of_nothing_is_never_certified_and_it_says_why():
    claim = Claim({"cost": 0.0}, largest={"cost": 1000.0})
    verdict = first_certified([0], lambda _: {"cost": np.zeros(10_000)}, claim, tests=1)
    assert verdict.certified is None
    assert 0 < verdict.shortfalls["mean_cost"] < 1
    assert verdict.alike == ["cost"]
    nothing_known = Claim({"cost": 25.0})
    verdict = first_certified([0], lambda _: {"cost": np.zeros(100)}, nothing_known, tests=1)
    assert verdict.shortfalls == {"mean_cost": np.inf}


@pytest.mark.parametrize("odd", [np.nan, np.inf], ids=["nan", "infinite"])
def test_a_cost_that_is_no_number_is_never_below_its_limit(odd):
    costs = {"cost": np.r_[odd, np.tile([0.0, 1.0], 200)]}
    claim = Claim({"cost": 25.0}, most_over=0.5)
    assert first_certified([0], lambda _: costs, claim, tests=1).certified is None
    assert claim.shortfalls(costs, tests=1) == {"mean_cost": np.inf}
    exact = stats.binomtest(1, 401).proportion_ci(0.9, method="exact").high
    assert share_bound(costs["cost"], 25.0, LEVEL) == pytest.approx(exact)
    # the others of a table keep their bounds
    both = mean_bound(np.stack([costs["cost"], np.r_[0.0, costs["cost"][1:]]]), LEVEL)
    assert np.isfinite(both).tolist() == [False, True]


def test_policies_with_costs_or_returns_that_are_no_numbers_are_tested_last():
    fair = {"cost": np.array([1.0, 2.0])}
    costs = [{"cost": np.array([np.nan, 2.0])}, fair, {"cost": np.array([90.0, 95.0])}, fair]
    returns = [[9.0, 9.0], [np.nan, 9.0], [5.0, 5.0], [1.0, 1.0]]
    assert rank(returns, costs, Claim({"cost": 25.0})) == [3, 1, 2, 0]
