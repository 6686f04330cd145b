"""Claims on episode costs, the order in which policies are tested, and the tests."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from safe_rl.scores.bounds import betting_bound
from safe_rl.scores.certificate import Claim, error_of_next_test, first_certified, rank

CLAIM = Claim({"cost": 25.0}, highest={"cost": 200.0})


def batches(costs, size=50):
    return [{"cost": costs[k : k + size]} for k in range(0, len(costs), size)]


def certify(rng, means, claim=CLAIM, tests=3, episodes=1000):
    """The whole procedure on policies with geometric costs; who costs more gets more."""
    draw = lambda mean, n: rng.geometric(1 / mean, n).astype(float).clip(0, 200)  # noqa: E731
    claims = [claim] * len(means)
    order = rank([np.full(50, m) for m in means], [{"cost": draw(m, 50)} for m in means], claims)
    collect = lambda k: batches(draw(means[k], episodes))  # noqa: E731
    return first_certified(order, collect, claims, tests, episodes)


def test_of_many_policies_above_the_limit_hardly_ever_one_is_certified():
    rng = np.random.default_rng(0)
    wrong = [certify(rng, [25.3] * 8).certified is not None for _ in range(100)]
    assert np.mean(wrong) < 0.05


def test_the_best_policy_that_keeps_the_limit_is_named():
    rng = np.random.default_rng(0)
    found = [certify(rng, [10.0, 16.0, 24.8, 40.0]).certified for _ in range(40)]
    assert found.count(1) > 36
    assert 3 not in found


def test_a_test_ends_as_soon_as_it_may_and_gives_up_where_there_is_no_hope():
    rng = np.random.default_rng(0)
    assert certify(rng, [10.0]).episodes < 200
    hopeless = certify(rng, [40.0, 32.0, 60.0])
    assert (hopeless.certified, hopeless.episodes) == (None, 200)


@pytest.mark.parametrize(("cost", "is_given_up"), [(0.24, True), (0.26, False)])
def test_a_test_is_given_up_below_a_quarter_of_what_its_best_bet_needs(cost, is_given_up):
    """Of constant costs, every episode multiplies the wealth of the largest bet by one factor."""
    needed = np.log(20) / np.log(1 + 0.99 * (25 - 24) / (200 - 25))  # episodes, of this bet alone
    most = round(cost * needed)
    free = {"kept": 9.0, "never": 8.0}
    claim = Claim({"cost": 25.0, "kept": 8.0, "never": 9.0}, highest={"cost": 200.0} | free)

    def may_end(episodes, most):
        costs = {"cost": np.full(episodes, 24.0), **{key: np.zeros(episodes) for key in free}}
        return claim.may_end(costs, 1, most)

    first = -(-most // 5)  # a fifth of the episodes
    assert [may_end(first - 1, most), may_end(first, most)] == [False, is_given_up]
    # all limits are shown, not only those that cost nothing
    assert [may_end(400, 4000), may_end(1000, 4000)] == [False, True]


def test_bounds_and_shortfalls_are_those_of_the_policy_that_fell_short_least():
    costs = [np.full(50, mean) for mean in (30.0, 27.0, 45.0)]
    verdict = first_certified([0, 1, 2], lambda k: batches(costs[k]), [CLAIM] * 3, 3, 50)
    assert verdict.certified is None
    assert verdict.tested == [0, 1, 2]
    bound = betting_bound(costs[1], 1 - 0.05 / 3, 200.0)
    assert verdict.bounds == {"mean_cost": (bound, 25.0)}
    assert verdict.shortfalls == {"mean_cost": bound - 25.0}
    assert verdict.highest == {"cost": 200.0}
    # 10 above a limit of 200 is less than 6 above one of 25
    costs = [{"cost": np.full(50, a), "other": np.full(50, b)} for a, b in ((31, 0), (0, 210))]
    claim = Claim({"cost": 25.0, "other": 200.0}, highest={"cost": 31.0, "other": 210.0})
    verdict = first_certified([0, 1], lambda k: [costs[k]], [claim] * 2, 2, 50)
    assert verdict.shortfalls == {"mean_other": pytest.approx(10.0)}


def test_nothing_tested_is_nothing_certified():
    assert first_certified([], dict, [], tests=3, episodes=9).certified is None


def test_no_more_policies_are_tested_than_share_the_error_and_no_more_episodes_than_are_asked_for():
    costs = [np.full(60, mean) for mean in (30.0, 31.0, 0.0, 0.0)]
    found = [
        first_certified([0, 1, 2, 3], lambda k: batches(costs[k]), [CLAIM] * 4, tests, 60)
        for tests in (2, 3)
    ]
    assert [(one.certified, one.tested) for one in found] == [(None, [0, 1]), (2, [0, 1, 2])]
    few = first_certified([0], lambda k: batches(costs[k]), [CLAIM], 1, 30)
    assert (few.episodes, few.bounds) == (30, CLAIM.bounds({"cost": costs[0][:30]}, 1))


def test_every_limit_is_tested_at_the_level_of_the_test():
    """A policy that breaks one limit has to pass that limit's test: no error to share out."""
    costs = {"cost": np.arange(50.0), "cost_hazards": np.arange(50.0) % 7}
    limits, highest = {"cost": 25.0, "cost_hazards": 5.0}, {"cost": 60.0, "cost_hazards": 9.0}
    claim = Claim(limits, most_over=0.3, level=0.9, highest=highest)
    level, expected = 1 - 0.1 / 3, {}
    for key, limit in limits.items():
        over = costs[key] > limit
        expected[f"mean_{key}"] = betting_bound(costs[key], level, highest[key])
        expected[f"over_limit_{key}"] = betting_bound(over, level, 1.0)
    found = claim.bounds(costs, tests=3)
    assert {name: bound for name, (bound, _) in found.items()} == pytest.approx(expected)
    assert [most for _, most in found.values()] == [25.0, 0.3, 5.0, 0.3]


def test_every_limit_has_to_be_kept():
    costs = {"cost": np.full(400, 10.0), "cost_hazards": np.full(400, 6.0)}
    claim = Claim({"cost": 25.0, "cost_hazards": 5.0}, highest={"cost": 20.0, "cost_hazards": 6.0})
    assert claim.shortfalls(costs, tests=1) == {"mean_cost_hazards": pytest.approx(1.0)}


def test_shares_of_episodes_can_be_asked_for():
    costs = {"cost": np.r_[np.zeros(300), np.full(200, 30.0)]}  # mean 12, two fifths over 25
    assert not CLAIM.shortfalls(costs, tests=1)
    assert list(replace(CLAIM, most_over=0.3).shortfalls(costs, tests=1)) == ["over_limit_cost"]
    assert not replace(CLAIM, most_over=0.5).shortfalls(costs, tests=1)


def test_costs_without_a_highest_count_up_to_a_cap_and_few_may_cost_more():
    costs = np.r_[np.full(799, 10.0), 900.0]
    found = Claim({"cost": 25.0}).bounds({"cost": costs}, tests=1)
    assert found == {
        "beyond_250_cost": (betting_bound(costs > 250, 0.95, 1.0), 0.01),
        "mean_cost": (betting_bound(costs.clip(max=250), 0.95, 250.0), 25.0),
    }
    lower = replace(CLAIM, cap=50.0).bounds({"cost": costs}, tests=1)
    assert list(lower) == ["beyond_50_cost", "mean_cost"]
    assert list(replace(CLAIM, cap=300.0).bounds({"cost": costs}, tests=1)) == ["mean_cost"]
    with pytest.raises(ValueError, match="cap=25: it must be above every limit"):
        replace(CLAIM, cap=25.0)
    with pytest.raises(ValueError, match="cap=10: it must be above every limit"):
        Claim({"cost": 25.0, "cost_hazards": 5.0}, cap=10.0)
    given = Claim({"cost": 25.0}, cap=100.0).bounds({"cost": costs}, tests=1)
    assert list(given) == ["beyond_100_cost", "mean_cost"]
    known = Claim({"cost": 25.0}, highest={"cost": 1000.0}).bounds({"cost": costs}, tests=1)
    assert known == {"mean_cost": (betting_bound(costs, 0.95, 1000.0), 25.0)}
    many = np.r_[np.full(780, 10.0), np.full(20, 260.0)]
    assert list(Claim({"cost": 25.0}).shortfalls({"cost": many}, tests=1)) == ["beyond_250_cost"]


def test_the_mean_of_the_costliest_episodes_is_bounded_from_above():
    rng = np.random.default_rng(0)
    costs = rng.exponential(10.0, 5000).clip(0, 100)
    claim = replace(CLAIM, tail=0.5).with_thresholds({"cost": rng.exponential(10.0, 50)})
    ((name, (bound, most)),) = claim.bounds({"cost": costs}, tests=1).items()
    # of an exponential distribution: the mean times 1 − log α
    truth = 10 * (1 - np.log(0.5))
    assert (name, most) == ("cvar_cost", 25.0)
    assert truth < bound < 1.4 * truth
    assert CLAIM.with_thresholds({"cost": costs}) is CLAIM


def test_what_is_tested_of_the_costliest_episodes_has_their_mean_and_the_highest_cost_of_all():
    costs = {"cost": np.r_[np.arange(9.0), 200.0]}
    (tested,) = replace(CLAIM, tail=0.2).with_thresholds(costs).statements(costs)
    assert tested.values.mean() == pytest.approx((8 + 200) / 2)
    assert tested.values.max() == pytest.approx(tested.highest)


def test_candidates_are_ordered_by_what_the_tests_will_ask_for():
    rng, claim = np.random.default_rng(0), Claim({"cost": 100.0, "cost_hazards": 5.0})
    means = [(99.0, 4.0), (90.0, 4.0), (110.0, 4.0), (90.0, 7.0)]
    costs = [
        {"cost": np.full(50, first), "cost_hazards": np.full(50, second)} for first, second in means
    ]
    # on average within its limit, but not by enough standard errors
    costs[0]["cost"] += 20 * stats.zscore(rng.normal(size=50))
    # then a tenth of a limit too much, and two fifths of another one
    assert rank([[9.0], [-5.0], [99.0], [999.0]], costs, [claim] * 4) == [1, 0, 2, 3]
    assert rank([[1.0], [2.0]], [{"cost": [1.0]}] * 2, [CLAIM] * 2) == [1, 0]  # of one episode


@pytest.mark.parametrize("highest", [{"cost": 1000.0}, {}])
def test_a_limit_of_0_is_never_certified(highest):
    claim = Claim({"cost": 0.0}, highest=highest)
    assert 0 < claim.shortfalls({"cost": np.zeros(10_000)}, tests=1)["mean_cost"] < 1
    found = claim.bounds({"cost": np.zeros(9)}, tests=1)
    assert list(found) == [*([] if highest else ["beyond_10_cost"]), "mean_cost"]


@pytest.mark.parametrize("odd", [np.nan, np.inf], ids=["nan", "infinite"])
def test_a_cost_that_is_no_number_is_never_below_its_limit(odd):
    costs = np.r_[odd, np.tile([0.0, 1.0], 200)]
    claim = replace(CLAIM, most_over=0.5)
    assert first_certified([0], lambda _: batches(costs), [claim], 1, 400).certified is None
    bounds = claim.bounds({"cost": costs}, tests=1)
    assert bounds["mean_cost"][0] == np.inf
    assert bounds["over_limit_cost"][0] == betting_bound(np.arange(401) == 0, 0.95, 1.0)
    cvar = replace(CLAIM, tail=0.1).with_thresholds({"cost": [0.0, odd]})
    assert first_certified([0], lambda _: batches(costs[1:]), [cvar], 1, 400).certified is None


def test_policies_with_costs_or_returns_that_are_no_numbers_are_tested_last():
    fair = {"cost": np.array([1.0, 2.0])}
    costs = [{"cost": np.array([np.nan, 2.0])}, fair, {"cost": np.array([90.0, 95.0])}, fair]
    returns = [[9.0, 9.0], [np.nan, 9.0], [5.0, 5.0], [1.0, 1.0]]
    assert rank(returns, costs, [CLAIM] * 4) == [3, 1, 2, 0]


@pytest.mark.parametrize("is_shared", [True, False])
def test_a_run_that_is_tested_until_it_passes_is_wrongly_certified_at_most_at_its_level(is_shared):
    # Student's bound of normal values is exact, so every test spends its whole error
    rng, spent = np.random.default_rng(1), []
    passes = np.zeros(1000, dtype=bool)
    for _ in range(5):
        error = error_of_next_test(0.95, spent) if is_shared else 0.05
        spent.append(error)
        costs = rng.normal(25.0, 5.0, (passes.size, 100))
        standard_error = costs.std(1, ddof=1) / 10
        passes |= costs.mean(1) + stats.t.ppf(1 - error, 99) * standard_error <= 25.0
    assert (passes.mean() < 0.065) == is_shared
    assert sum(spent) < 0.05 or not is_shared


def test_the_error_that_is_left_may_be_none():
    assert error_of_next_test(0.99, [0.0375]) < 0


@pytest.mark.parametrize("claim", [CLAIM, replace(CLAIM, highest={})], ids=["bounded", "unbounded"])
def test_the_fewest_episodes_that_can_suffice_do_if_none_costs_anything(claim):
    number = claim.fewest(tests=3)
    is_shown = [not claim.shortfalls({"cost": np.zeros(n)}, 3) for n in (number - 1, number)]
    assert is_shown == [False, True]
    # a share of 1 in 100 above the cap needs more than 300 episodes
    assert (number > 300) == (claim is not CLAIM)


def test_what_no_episode_can_exceed_holds_by_construction():
    claim = replace(CLAIM, highest={"cost": 25.0})
    found = first_certified([0], lambda k: batches(np.full(100, 25.0)), [claim], 1, 3000)
    assert (found.certified, found.by_construction) == (0, ["mean_cost"])
    assert (found.episodes, found.bounds["mean_cost"][0] <= 25.0) == (50, True)
    dearer = first_certified([0], lambda k: batches(np.full(50, 26.0)), [claim], 1, 50)
    assert (dearer.certified, dearer.by_construction) == (None, [])
