"""The rules by which agents are compared (section 5.1 of the paper)."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from typing import NamedTuple

__all__ = ["NOISE_OF_ZERO", "Agent", "compare", "dominates"]

NOISE_OF_ZERO = 0.1
"""Normalised violation up to which a slate counts as constraint-satisfying.

The paper asks for "zero (or within noise of zero)" and gives no number. In its tables what it calls
satisfying is at most 0.056, and everything else at least 0.35.
"""


class Agent(NamedTuple):
    """What the rules of comparison look at.

    Attributes:
        episode_return: J_r, or J̄_r of a slate.
        cost_rate: ρ_c, or ρ̄_c.
        is_satisfying: Whether every constraint is satisfied.
        steps: What has to be equal in two agents that are compared: environment steps of training,
            one number per environment of a slate; where they differ, the limits, too.
    """

    episode_return: float
    cost_rate: float
    is_satisfying: bool
    steps: Hashable


def dominates(first: Agent, second: Agent) -> bool:
    """Whether the first of two constraint-satisfying agents dominates the second: A₁ ≻ A₂.

    It has to be strictly better in return or cost rate, at least as good in the other, and both
    must have been trained equally long.

    Examples:
        >>> good, fair = Agent(10.0, 0.02, True, 1e6), Agent(10.0, 0.03, True, 1e6)
        >>> dominates(good, fair), dominates(fair, good), dominates(good, good)
        (True, False, False)
    """
    if not (first.is_satisfying and second.is_satisfying) or first.steps != second.steps:
        return False
    at_least_as_good = (
        first.episode_return >= second.episode_return and first.cost_rate <= second.cost_rate
    )
    better = first.episode_return > second.episode_return or first.cost_rate < second.cost_rate
    return at_least_as_good and better


def compare(agents: Mapping[str, Agent]) -> Iterator[tuple[str, str, str]]:
    """Every pair of which one is better, by the rules of section 5.1: (better, worse, reason).

    An agent that fails its constraints is worse than all that satisfy theirs; among those that do
    satisfy them, better means to dominate. Agents that were trained for different times are not
    compared: the paper has none.

    Examples:
        >>> safe, rash = Agent(1.0, 0.02, True, 1e6), Agent(20.0, 0.06, False, 1e6)
        >>> list(compare({"safe": safe, "rash": rash}))
        [('safe', 'rash', 'satisfies')]
    """
    for name, agent in agents.items():
        for other_name, other in agents.items():
            if agent.steps != other.steps:
                continue
            if agent.is_satisfying and not other.is_satisfying:
                yield name, other_name, "satisfies"
            elif dominates(agent, other):
                yield name, other_name, "dominates"
