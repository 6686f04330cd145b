"""Upper confidence bounds of what a policy costs, and which of several policies keeps its limits.

A mean below its limit on the episodes that a policy was chosen by says little: the luckiest of many
was chosen. Here policies are ranked on one half of the episodes and tested on the other, at a level
that is shared out among the tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import NormalDist

import numpy as np
import scipy  # which loads its parts when they are asked for: half a second
from numpy.typing import ArrayLike

__all__ = ["Claim", "Verdict", "first_certified", "mean_bound", "rank", "share_bound"]


def mean_bound(values: ArrayLike, level: float, largest: float = math.inf) -> np.ndarray:
    """Upper confidence bound of the mean of a distribution that may have a heavy right tail.

    x̄ + (t + γ (1 + 2 t²) / (6 √n)) s / √n, with Student's quantile t and the skewness γ where it is
    positive (Chen, "Testing the mean of skewed distributions", 1995): episode costs are skewed, and
    Student's bound alone falls below their mean too often. A sample underestimates the skewness of
    a heavy tail; γ is twice the sample's, with which lognormal costs (σ = 0.9) keep the level too.

    A sample without any spread says nothing of that of its distribution. Then the bound is
    x̄ + p (m − x̄), with the exact upper bound p of the share of values that are others
    (`share_bound`) and the largest possible value m: it holds for every distribution.

    Args:
        values: Independent values, shape [..., n].
        level: Confidence, in (0.5, 1).
        largest: The largest possible value, m.

    Returns:
        The bound, shape [...]; infinite for fewer than two values, or where one is no number.

    Examples:
        >>> float(mean_bound([20.0, 22.0, 24.0, 26.0], level=0.95).round(2))
        26.04
        >>> float(mean_bound([0.0] * 59, level=0.95, largest=100.0).round(1))  # 5 % may cost 100
        5.0
    """
    values = np.asarray(values, dtype=float)
    values = np.where(np.isfinite(values), values, np.nan)
    number = values.shape[-1]
    if number < 2:
        return np.full(values.shape[:-1], np.inf)
    mean, spread = values.mean(-1), values.std(-1, ddof=1)
    cubes = ((values - mean[..., np.newaxis]) ** 3).mean(-1)
    sample = np.divide(cubes, spread**3, out=np.zeros_like(mean), where=spread > 0)
    quantile = scipy.stats.t.ppf(level, number - 1)
    correction = 2 * sample.clip(0) * (1 + 2 * quantile**2) / (6 * np.sqrt(number))
    bound = mean + (quantile + correction) * spread / np.sqrt(number)
    others = share_bound(np.zeros(number), 0.0, level)
    bound = np.where(_are_alike(values), mean + others * (largest - mean).clip(0), bound)
    # NaN is above no limit, and would be taken for a bound that keeps all
    return np.where(np.isnan(bound), np.inf, bound)


def _are_alike(values: ArrayLike) -> np.ndarray:
    """Whether all of n values [..., n] are the same, [...]."""
    values = np.asarray(values, dtype=float)
    return values.min(-1) == values.max(-1)


def share_bound(values: ArrayLike, limit: float, level: float) -> float:
    """Upper confidence bound of P(value > limit), exact (Clopper and Pearson 1934).

    A value that is no number counts as one above it.

    Examples:
        >>> round(share_bound([1.0] * 59, limit=2.0, level=0.95), 3)  # none of 59: below 5 %
        0.05
    """
    values = np.asarray(values, dtype=float)
    over, number = int((~(values <= limit)).sum()), len(values)
    if over == number:
        return 1.0
    return float(scipy.stats.beta.ppf(level, over + 1, number - over))


@dataclass(frozen=True)
class Claim:
    """What is to be certified of a policy's episode costs.

    Attributes:
        limits: Cost key -> d, of the mean cost per episode.
        most_over: Largest share of episodes that may cost more than d; 1 asks for nothing.
        level: Confidence of the whole statement.
        largest: Cost key -> the most that an episode can cost; infinite where nothing is said.

    Examples:
        >>> Claim({"cost": 25.0}).shortfalls({"cost": [20.0, 21.0, 22.0, 20.0]}, tests=1)
        {}
    """

    limits: Mapping[str, float]
    most_over: float = 1.0
    level: float = 0.95
    largest: Mapping[str, float] = field(default_factory=dict)

    def bounds(self, costs: Mapping[str, ArrayLike], tests: int) -> dict[str, tuple[float, float]]:
        """Every upper confidence bound beside what it has to keep, by name.

        Args:
            costs: Cost key -> episode costs, [E].
            tests: Policies tested at most; together with the bounds of a policy they share the
                error (Bonferroni).
        """
        asks_for_shares = self.most_over < 1
        number = tests * len(self.limits) * (2 if asks_for_shares else 1)
        level = 1 - (1 - self.level) / max(1, number)
        largest = dict.fromkeys(self.limits, math.inf) | {**self.largest}
        bounds = {
            f"mean_{key}": (float(mean_bound(costs[key], level, largest[key])), limit)
            for key, limit in self.limits.items()
        }
        if asks_for_shares:
            bounds |= {
                f"over_limit_{key}": (share_bound(costs[key], limit, level), self.most_over)
                for key, limit in self.limits.items()
            }
        return bounds

    def shortfalls(self, costs: Mapping[str, ArrayLike], tests: int) -> dict[str, float]:
        """By how much bounds exceed what they have to keep; empty if the claim is certified."""
        bounds = self.bounds(costs, tests)
        return {name: bound - most for name, (bound, most) in bounds.items() if bound > most}

    def may_hold(self, costs: Mapping[str, ArrayLike]) -> bool:
        """Whether the claim holds of these episodes themselves, so that more might show it."""
        return all(
            np.mean(values) < limit and np.mean(~(values <= limit)) <= self.most_over
            for key, limit in self.limits.items()
            for values in [np.asarray(costs[key], dtype=float)]
        )

    def alike(self, costs: Mapping[str, ArrayLike]) -> list[str]:
        """Names of costs that were the same in all episodes, [E] each."""
        return [key for key in self.limits if _are_alike(costs[key])]


@dataclass(frozen=True)
class Verdict:
    """The result of testing candidates.

    Attributes:
        certified: Number of the policy that is certified, or None.
        tested: Numbers of the policies that were tested, in this order: twice that of one whose
            second test was on more episodes.
        bounds: Of the policy that is certified, or else of the one that fell short least: name ->
            (bound, what it has to keep).
        shortfalls: Of the same policy, if none is certified.
        alike: Costs that were the same in all its episodes: bounds on them are about episodes that
            nobody has seen.
    """

    certified: int | None
    tested: list[int]
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    shortfalls: dict[str, float] = field(default_factory=dict)
    alike: list[str] = field(default_factory=list)


def rank(
    returns: Sequence[ArrayLike], costs: Sequence[Mapping[str, ArrayLike]], claim: Claim
) -> list[int]:
    """Order candidates for the tests: those likely to pass by return, then the others by cost.

    Likely is a policy whose mean costs on these episodes are within the limits by z standard
    errors, with the normal distribution's quantile z of the claim's level: those that the test,
    on other episodes, will ask for.

    Args:
        returns: Episode returns of every candidate.
        costs: Cost key -> episode costs, of every candidate.
        claim: What is to be certified.
    """

    def key(candidate: int) -> tuple[bool, float]:
        excess = max(_expected_excess(costs[candidate], claim), default=0.0)
        loss = -float(np.asarray(returns[candidate], dtype=float).mean())
        return excess > 0, excess if excess > 0 else _or_infinite(loss)

    return sorted(range(len(returns)), key=key)


def _expected_excess(costs: Mapping[str, ArrayLike], claim: Claim) -> list[float]:
    """Mean cost plus z standard errors less the limit, in units of the limit, for every limit."""
    excesses = []
    for name, limit in claim.limits.items():
        values = np.asarray(costs[name], dtype=float)
        error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
        quantile = NormalDist().inv_cdf(claim.level)
        expected = float(values.mean() + quantile * error)
        excesses.append((_or_infinite(expected) - limit) / max(limit, 1.0))
    return excesses


def _or_infinite(value: float) -> float:
    """A number; infinity for what is none, which sorts it behind all others."""
    return math.inf if math.isnan(value) else value


def first_certified(
    order: Sequence[int],
    collect: Callable[[int], Mapping[str, ArrayLike]],
    claim: Claim,
    tests: int,
    collect_more: Callable[[int], Mapping[str, ArrayLike]] | None = None,
) -> Verdict:
    """Test candidates in order on fresh episodes until one is certified.

    Args:
        order: Numbers of the candidates, from :func:`rank`.
        collect: Episode costs of a candidate that had no part in the order.
        claim: What is to be certified.
        tests: Candidates tested at most: the fewer, the sharper each test.
        collect_more: Costs of more episodes, none of which was in another test. If no candidate is
            certified, the one that fell short least has one more test on these, where its episodes
            so far keep the limits; it shares the error of all tests. None for none.

    Examples:
        >>> costs = [[26.0, 30.0, 31.0], [15.0, 16.0, 14.0]]
        >>> collect = lambda number: {"cost": costs[number]}
        >>> first_certified([0, 1], collect, Claim({"cost": 25.0}), tests=2).certified
        1
    """
    in_all = tests + (collect_more is not None)
    tested: list[int] = []

    def test(candidate: int, costs: Mapping[str, ArrayLike]) -> Verdict:
        tested.append(candidate)
        bounds, missing = claim.bounds(costs, in_all), claim.shortfalls(costs, in_all)
        if not missing:
            return Verdict(candidate, tested, bounds)
        return Verdict(None, tested, bounds, missing, claim.alike(costs))

    fell_short: dict[int, Verdict] = {}
    hopeful: list[int] = []
    for candidate in order[:tests]:
        costs = collect(candidate)
        verdict = test(candidate, costs)
        if verdict.certified is not None:
            return verdict
        fell_short[candidate] = verdict
        if claim.may_hold(costs):
            hopeful.append(candidate)
    verdicts = list(fell_short.values())
    if collect_more is not None and hopeful:
        nearest = min(hopeful, key=lambda number: _furthest(fell_short[number]))
        verdicts.append(test(nearest, collect_more(nearest)))
    return min(verdicts, key=_furthest, default=Verdict(None, tested))


def _furthest(verdict: Verdict) -> float:
    """By how much the worst bound exceeds what it has to keep; 0 of what is certified."""
    return max(verdict.shortfalls.values(), default=0.0)
