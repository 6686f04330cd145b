"""Statistical tests of which of several policies keeps its limits.

If a policy was chosen by its mean cost on some episodes, this mean says little, because the
luckiest of many policies was chosen. So policies are ranked by some episodes and tested on others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from safe_rl.scores.bounds import Statement

__all__ = ["Claim", "Verdict", "error_of_next_test", "first_certified", "rank"]

Costs = Mapping[str, ArrayLike]

_SPENT_AT_ONCE = 0.75  # share of the error left that one test spends; the first loses little by it


def error_of_next_test(level: float, spent: Iterable[float]) -> float:
    """Error probability of the next test of a run, such that all of its tests share one level.

    Every test spends three quarters of the error that earlier ones have left: the result is 0 or
    less if they have ``spent`` all of it. The sum of all errors stays below 1 − ``level``, however
    many tests there are and whatever decides on them.

    Examples:
        >>> first = error_of_next_test(0.95, [])
        >>> round(first, 4), round(error_of_next_test(0.95, [first]), 4)
        (0.0375, 0.0094)
    """
    return _SPENT_AT_ONCE * (1 - level - sum(spent))


@dataclass(frozen=True)
class Claim:
    """The claim about a policy's episode costs that is to be certified.

    Attributes:
        limits: Cost key -> d, limit of the mean cost per episode.
        most_over: Largest share of episodes that may cost more than d; 1: no bound.
        level: Confidence of the whole statement.
        highest: Cost key -> the highest possible cost of an episode; infinite if not given.
        cap: Costs of episodes count only up to this value, above all limits, and at most a share
            ``most_beyond`` of them may cost more. None: no cap, or, if the highest cost is
            infinite, a cap of ten times the limit (of 10 for a limit of 0).
        most_beyond: Largest share of episodes that may cost more than a cap.
        tail: Share α of the episodes with the highest costs, whose mean is limited (CVaR); 1: the
            mean of all episodes is limited.
        thresholds: With a tail below 1: cost key -> ν. The CVaR is at most ν + E[(C − ν)₊] / α for
            every ν that is chosen before the test, and equal to it if a share α of the episodes
            costs more than ν.

    Raises:
        ValueError: If the cap is not above every limit.

    Examples:
        >>> claim = Claim({"cost": 25.0}, highest={"cost": 50.0})
        >>> claim.shortfalls({"cost": [20.0, 21.0, 22.0, 20.0] * 25}, tests=1)
        {}
    """

    limits: Mapping[str, float]
    most_over: float = 1.0
    level: float = 0.95
    highest: Mapping[str, float] = field(default_factory=dict)
    cap: float | None = None
    most_beyond: float = 0.01
    tail: float = 1.0
    thresholds: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.cap is not None and any(self.cap <= limit for limit in self.limits.values()):
            raise ValueError(
                f"certificate.cap={self.cap:g}: it must be above every limit of cost_limits, or "
                "every policy would keep that limit."
            )

    def with_thresholds(self, costs: Costs) -> Claim:
        """The claim with ν set to the value at risk of episodes that are in no test."""
        if self.tail == 1:
            return self
        quantiles = {key: np.quantile(np.asarray(costs[key]), 1 - self.tail) for key in self.limits}
        return replace(self, thresholds={key: float(q) for key, q in quantiles.items()})

    def statements(self, costs: Costs) -> list[Statement]:
        """All statements that have to be shown, with their values for some episodes, [E] each."""
        return [s for key in self.limits for s in self._about(key, np.asarray(costs[key], float))]

    def _about(self, key: str, costs: np.ndarray) -> Iterator[Statement]:
        limit, highest = self.limits[key], self.highest.get(key, math.inf)
        # with a cap of 0, every policy would keep a limit of 0
        cap = 10 * (limit or 1.0) if self.cap is None and math.isinf(highest) else self.cap
        capped = costs
        if cap is not None and cap < highest:
            capped, highest = np.where(np.isnan(costs), costs, costs.clip(max=cap)), cap
            yield Statement(f"beyond_{cap:g}_{key}", self.most_beyond, 1.0, _above(costs, cap))
        if self.tail < 1:
            start = self.thresholds[key]
            excess = start + (capped - start).clip(0) / self.tail
            highest = max(start, start + (highest - start) / self.tail)
            yield Statement(f"cvar_{key}", limit, highest, excess)
        else:
            yield Statement(f"mean_{key}", limit, highest, capped)
        if self.most_over < 1:
            yield Statement(f"over_limit_{key}", self.most_over, 1.0, _above(costs, limit))

    def bounds(self, costs: Costs, tests: int) -> dict[str, tuple[float, float]]:
        """Every upper confidence bound and its limit, by name.

        All limits have to be kept. So each bound is at the level of the whole test: a policy that
        violates a limit has to pass the test of that limit (intersection–union test).

        Args:
            costs: Cost key -> episode costs, [E].
            tests: Largest number of policies tested; they share the error (Bonferroni).
        """
        level = self._level(tests)
        return {s.name: (s.bound(level), s.limit) for s in self.statements(costs)}

    def shortfalls(self, costs: Costs, tests: int) -> dict[str, float]:
        """By how much bounds exceed their limits; empty if the claim is certified."""
        return _shortfalls(self.bounds(costs, tests))

    def fewest(self, tests: int) -> float:
        """Number of episodes below which no test can succeed, even if no episode costs anything."""
        level = self._level(tests)
        nothing = {key: np.zeros(1) for key in self.limits}
        return max((statement.fewest(level) for statement in self.statements(nothing)), default=1)

    def may_end(self, costs: Costs, tests: int, most: int) -> bool:
        """Whether a test of up to ``most`` episodes may end early.

        It may if all statements have been shown, or if the test will probably fail.
        """
        level, statements = self._level(tests), self.statements(costs)
        if all(statement.is_shown(level) for statement in statements):
            return True
        is_long = 5 * min((len(statement.values) for statement in statements), default=0) >= most
        return is_long and any(statement.is_hopeless(level, most) for statement in statements)

    def _level(self, tests: int) -> float:
        return 1 - (1 - self.level) / max(1, tests)


def _shortfalls(bounds: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    return {name: bound - most for name, (bound, most) in bounds.items() if bound > most}


def _above(costs: np.ndarray, limit: float) -> np.ndarray:
    """1 for every episode whose cost is above the limit or NaN, else 0; [E]."""
    return (~(costs <= limit)).astype(float)


@dataclass(frozen=True)
class Verdict:
    """The result of testing candidates.

    Attributes:
        certified: Number (index) of the policy that is certified, or None.
        tested: Numbers of the policies that were tested, in this order.
        bounds: Of the certified policy, or else of the one that missed its limits least: name ->
            (bound, limit).
        shortfalls: Of the same policy, if none is certified.
        by_construction: Of the same policy: names of means that no episode can raise above its
            limit.
        highest: Cost key -> the highest possible cost of an episode, where it is known.
        episodes: Episodes of its test.
    """

    certified: int | None
    tested: list[int]
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    shortfalls: dict[str, float] = field(default_factory=dict)
    by_construction: list[str] = field(default_factory=list)
    highest: dict[str, float] = field(default_factory=dict)
    episodes: int = 0


def rank(
    returns: Sequence[ArrayLike], costs: Sequence[Costs], claims: Sequence[Claim]
) -> list[int]:
    """Order candidates for the tests: those likely to pass by return, then the others by cost.

    A policy is likely to pass if its means on these episodes are below the limits by at least z
    standard errors, where z is the normal distribution's quantile of the claim's level.
    """

    def key(candidate: int) -> tuple[bool, float]:
        claim = claims[candidate]
        statements = claim.statements(costs[candidate])
        excess = max((_expected_excess(s, claim.level) for s in statements), default=0.0)
        loss = -float(np.asarray(returns[candidate], dtype=float).mean())
        return excess > 0, excess if excess > 0 else _or_infinite(loss)

    return sorted(range(len(returns)), key=key)


def _expected_excess(statement: Statement, level: float) -> float:
    """Mean plus z standard errors minus the limit, in units of the limit."""
    values = statement.values
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    expected = float(values.mean() + NormalDist().inv_cdf(level) * error)
    # not in units of the limit if that is a small share: so few episodes show no rare ones
    return (_or_infinite(expected) - statement.limit) / max(statement.limit, 1.0)


def _or_infinite(value: float) -> float:
    """A number; infinity in place of NaN, so that it is sorted last."""
    return math.inf if math.isnan(value) else value


def first_certified(
    order: Sequence[int],
    collect: Callable[[int], Iterable[Costs]],
    claims: Sequence[Claim],
    tests: int,
    episodes: int,
) -> Verdict:
    """Test candidates in order on fresh episodes until one is certified.

    A test ends as soon as its bounds are within the limits, or when it will probably fail.

    Args:
        order: Numbers of the candidates, from `rank`.
        collect: Costs of a candidate's fresh episodes, batch by batch.
        claims: Claim about each candidate.
        tests: Largest number of candidates tested; they share the error.
        episodes: Largest number of episodes of a test.

    Examples:
        >>> costs = [[26.0, 30.0, 31.0], [15.0, 16.0, 14.0]]
        >>> collect = lambda number: [{"cost": costs[number]}] * 20
        >>> claim = Claim({"cost": 25.0}, highest={"cost": 50.0})
        >>> first_certified([0, 1], collect, [claim] * 2, tests=2, episodes=60).certified
        1
    """
    verdicts: list[Verdict] = []
    for candidate in order[:tests]:
        verdict = _test(candidate, collect(candidate), claims[candidate], tests, episodes)
        verdicts.append(verdict)
        if verdict.certified is not None:
            return replace(verdict, tested=list(order[: len(verdicts)]))
    # by how much the worst bound of each candidate exceeds its limit, in the units of `rank`
    excess = [max((b - d) / max(d, 1.0) for b, d in v.bounds.values()) for v in verdicts]
    closest = verdicts[int(np.argmin(excess))] if verdicts else Verdict(None, [])
    return replace(closest, tested=list(order[:tests]))


def _test(
    candidate: int, batches: Iterable[Costs], claim: Claim, tests: int, episodes: int
) -> Verdict:
    """The verdict on one candidate."""
    costs: dict[str, np.ndarray] = {key: np.empty(0) for key in claim.limits}
    number = 0
    for batch in batches:
        costs = {key: np.r_[costs[key], np.asarray(batch[key], float)][:episodes] for key in costs}
        number = min((len(values) for values in costs.values()), default=episodes)
        if number >= episodes or claim.may_end(costs, tests, episodes):
            break
    bounds = claim.bounds(costs, tests)
    missing = _shortfalls(bounds)
    statements = claim.statements(costs)
    return Verdict(
        certified=None if missing else candidate,
        tested=[],
        bounds=bounds,
        shortfalls=missing,
        by_construction=[
            s.name for s in statements if s.is_by_construction and s.name not in missing
        ],
        highest=dict(claim.highest),
        episodes=number,
    )
