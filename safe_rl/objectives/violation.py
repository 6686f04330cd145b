"""Violations of cost limits, as losses and trust-region steps read them."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor


class Violations(Protocol):
    """Violations that a loss reads at every call, such as a `safe_rl.algorithms.Constraints`.

    Attributes:
        violation: Amount by which J_c must fall, undiscounted cost per episode, [k]: J_c − d, or
            J_c minus its current target with a `safe_rl.objectives.LimitTracker`.
        episode_length: T̄, mean number of steps of an episode, scalar.
    """

    violation: Tensor
    episode_length: Tensor


class KnownCosts(Violations, Protocol):
    """Costs that losses with cost critics read, such as a `safe_rl.algorithms.Constraints`.

    Attributes:
        costs: J_c, undiscounted cost per episode, [k].
        unit: Typical size of one cost, [k]; see `EpisodeCosts.unit`.
    """

    costs: Tensor
    unit: Tensor


def matched_violation(violation: Tensor | None, surrogates: Tensor) -> Tensor:
    """J_c − d with the dtype and the device of the cost surrogates, [k].

    Before the first batch, violations are NaN. They count as 0: the policy is assumed to be exactly
    at its limits.

    Args:
        violation: J_c − d of every constraint, [k].
        surrogates: Cost surrogates, [k].

    Raises:
        ValueError: If there is not one violation per surrogate.

    Examples:
        >>> matched_violation(torch.tensor([-5.0, torch.nan]), surrogates=torch.zeros(2))
        tensor([-5.,  0.])
    """
    found = None if violation is None else torch.as_tensor(violation)
    if found is None or found.shape != surrogates.shape:
        shape = "missing" if found is None else f"of shape {tuple(found.shape)}"
        raise ValueError(
            f"There are {surrogates.numel()} cost surrogate(s), and violations are {shape}: a "
            "constrained step needs cost_violation, one per cost surrogate, and cost_advantage "
            "needs one column per cost limit."
        )
    return found.to(surrogates).nan_to_num(nan=0.0)


def violation_of(violations: Violations, surrogates: Tensor) -> Tensor:
    """`matched_violation` of the constraints that a loss reads at every call, [k]."""
    return matched_violation(violations.violation, surrogates)


def constraint_value(
    cost_violation: Tensor, episode_length: Tensor, rescale_violation: bool
) -> Tensor:
    """c, the constraint violation in the units of the cost surrogate's gradient, [k].

    A cost surrogate is an average per step, so the violation of an episode's cost has to be
    divided by the episode's length.

    Args:
        cost_violation: J_c − d, [k]. NaN (no episode has finished) counts as 0: the policy is
            assumed to be at the limit, and must not raise the cost.
        episode_length: T̄, scalar.
        rescale_violation: Whether to divide.
    """
    divisor = episode_length if rescale_violation else torch.ones_like(episode_length)
    return (cost_violation / divisor).nan_to_num(nan=0.0)
