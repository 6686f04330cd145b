"""Checks that environments of every family make before a state is set, or a step is taken."""

from __future__ import annotations

from collections.abc import Collection

from tensordict import TensorDictBase
from torch import Tensor


class ResetNeededError(RuntimeError):
    """A step before the first reset: there is no episode that it could be one of."""


def require_episodes(begun: Tensor) -> None:
    """Check that every environment is in an episode.

    Args:
        begun: environments that were reset or put into a state, bool [N].

    Raises:
        ResetNeededError: if some were not.
    """
    if not begun.all():
        rows = (~begun).nonzero()[:, 0].tolist()
        which = "" if not begun.any() else f" of rows {rows}"
        raise ResetNeededError(f"No episode has begun{which}: call reset() before the first step.")


def check_state(
    expected: TensorDictBase,
    state: TensorDictBase,
    optional: Collection[str],
    finite: Collection[str] = (),
) -> None:
    """Compare a state with one that the environment made.

    Args:
        expected: the environment's own.
        state: what is about to be set.
        optional: keys that may be missing.
        finite: keys that may hold no NaN or infinity; elsewhere they are failures of the physics.

    Raises:
        KeyError: if another key is missing.
        ValueError: if a shape or a type does not fit, or a number is not finite.
    """
    for key, value in expected.items():
        if key not in state:
            if key not in optional:
                needed = sorted(set(expected.keys()) - set(optional))
                raise KeyError(f"The state lacks '{key}'; it needs {needed}.")
            continue
        given = state[key]
        if given.shape != value.shape:
            raise ValueError(
                f"State '{key}' must have shape {tuple(value.shape)} in this environment, got "
                f"{tuple(given.shape)}."
            )
        if not value.dtype.is_floating_point and given.dtype != value.dtype:
            raise ValueError(f"State '{key}' must be {value.dtype}, got {given.dtype}.")
        if key in finite and not given.isfinite().all():
            raise ValueError(f"State '{key}' has numbers that are not finite.")
