"""Checks of a state before it is set."""

from __future__ import annotations

from tensordict import TensorDictBase

OPTIONAL_KEYS = ("place", "observation", "seed", "episode")


def check_state(expected: TensorDictBase, state: TensorDictBase) -> None:
    """Compare a state with one that the environment made.

    Args:
        expected: the environment's own.
        state: what is about to be set.

    Raises:
        KeyError: if a key is missing that is not optional.
        ValueError: if a shape does not fit.
    """
    for key, value in expected.items():
        if key in state:
            if state[key].shape != value.shape:
                raise ValueError(
                    f"State '{key}' must have shape {tuple(value.shape)} in this environment, got "
                    f"{tuple(state[key].shape)}."
                )
        elif key not in OPTIONAL_KEYS:
            needed = sorted(set(expected.keys()) - set(OPTIONAL_KEYS))
            raise KeyError(f"The state lacks '{key}'; it needs {needed}.")
