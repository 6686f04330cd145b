"""Which keys of its environment an evaluation of a run may change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from safe_rl.naming import did_you_mean

__all__ = ["check_env_keys"]


def check_env_keys(env: Mapping[str, Any], keys: Iterable[str]) -> None:
    """Refuse keys that an environment of one's own family does not have.

    Such a family ignores other keys, and the result would be said to be of another environment
    than it is.

    Args:
        env: Node of a run's environment.
        keys: Which of its keys are to be changed.

    Raises:
        ValueError: If the run's environment has no such key.

    Examples:
        >>> check_env_keys({"_target_": "mine.make", "edge": 1.0}, ["edgy"])
        Traceback (most recent call last):
        ValueError: env.edgy: mine.make has no such key. Did you mean 'edge'? The run has edge.
    """
    target = str(env.get("_target_", "safe_rl."))
    if target.startswith("safe_rl."):
        return
    own = [key for key in env if key not in ("_target_", "name")]
    for key in keys:
        if key not in env:
            known = f"The run has {', '.join(own)}." if own else "The run has none."
            raise ValueError(
                f"env.{key}: {target} has no such key.{did_you_mean(key, own)} {known}"
            )
