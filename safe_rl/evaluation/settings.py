"""What an evaluation can be told."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from safe_rl.scores.intervals import check_share

__all__ = ["EvaluationOptions", "check_options"]


def _option(default: Any, help: str) -> Any:
    return field(default=default, metadata={"help": help})


@dataclass
class EvaluationOptions:
    """Options of ``python -m safe_rl.evaluate``; the help texts say what they mean.

    Examples:
        >>> EvaluationOptions(episodes=10, env={"hazards_num": 12}).checkpoint
        'last'
    """

    episodes: int = _option(100, "whole episodes to run")
    checkpoint: str = _option(
        "last", "last, best (highest return that kept every limit), certified, or a path"
    )
    deterministic: bool = _option(False, "act with the policy's mean instead of sampling from it")
    seed: int | None = _option(
        None, "of layouts and actions; null: one that training never used, see docs/protocol.md"
    )
    num_envs: int = _option(25, "worlds that are stepped together")
    num_threads: int = _option(0, "threads that step them; 0: one per core")
    device: str = _option("cpu", "of the policy")
    cvar_alpha: float = _option(0.1, "share of the costliest episodes in the CVaR")
    video: bool = _option(False, "write an MP4 of the first episode (extra 'video')")
    camera: str = _option("free", "of the video: free, fixednear, fixedfar, track or vision")
    certify: bool = _option(
        False, "find the best checkpoint that surely keeps the limits, instead of evaluating one"
    )
    name: str = _option("", "told apart by it, several evaluations of a run can stand side by side")
    env: dict[str, Any] = field(
        default_factory=dict,
        metadata={"help": "keys of the environment, as in training: env.hazards_num=12"},
    )


def check_options(options: EvaluationOptions) -> None:
    """Refuse what cannot be done before anything is.

    Raises:
        ValueError: If an option is out of its range; the message names it.
    """
    for name in ("episodes", "num_envs"):
        value = getattr(options, name)
        if value < 1:
            raise ValueError(f"{name}={value}: at least 1.")
    check_share(options.cvar_alpha)
