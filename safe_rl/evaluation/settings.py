"""What an evaluation can be told."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safe_rl.scores.comparisons import check_share

__all__ = ["EvaluationOptions", "check_device", "check_options", "option"]

# Threads beyond it are not to be had, and worlds fill the memory.
_RANGES = {
    "episodes": (1, 10**8),
    "num_envs": (1, 100_000),
    "num_threads": (0, 1024),
    "seed": (0, 2**62),
}


_PICTURES = (".gif", ".webp")


def option(default: Any, help: str) -> Any:
    """A field of a command's options; a default that changes is given by what makes it."""
    kind = "default_factory" if callable(default) else "default"
    return field(metadata={"help": help}, **{kind: default})


@dataclass
class EvaluationOptions:
    """Options of ``python -m safe_rl.evaluate``; the help texts say what they mean.

    Examples:
        >>> EvaluationOptions(episodes=10, env={"hazards_num": 12}).checkpoint
        'last'
    """

    episodes: int = option(100, "whole episodes to run")
    checkpoint: str = option(
        "last", "last, best (highest return that kept every limit), certified, or a path"
    )
    deterministic: bool = option(False, "act with the policy's mean instead of sampling from it")
    seed: int | None = option(
        None, "seed of layouts and actions; null: one that training never used"
    )
    num_envs: int = option(25, "environments that are stepped together")
    num_threads: int = option(0, "threads that step them; 0: one per core")
    device: str = option("cpu", "where the policy acts: cpu or cuda")
    cvar_alpha: float = option(0.1, "share of the costliest episodes in the CVaR")
    video: bool = option(
        False,
        "write an MP4 of an episode from the first layout (extra 'video')",
    )
    picture: str | None = option(
        None, "file for an animated picture of that episode, .gif or .webp"
    )
    camera: str = option("free", "of the video: free, fixednear, fixedfar, track or vision")
    record: bool = option(False, "write every transition to disk, for dataset.path=…")
    certify: bool = option(False, "find and certify the best checkpoint that keeps the limits")
    certificate: dict[str, Any] = option(
        dict, "with certify=true: certificate.episodes=2000, as in training"
    )
    cost_limits: dict[str, float] = option(
        dict, "limits to use instead of the run's own, such as '{cost: 10}'"
    )
    name: str = option("", "suffix of the files, to keep several evaluations of a run")
    variations: Any = option(
        None, "evaluate in changed environments: dynamics, sensing, layout, a YAML, keys"
    )
    env: dict[str, Any] = option(
        dict, "keys of the environment, as in training: env.hazards_num=12"
    )


def check_options(options: EvaluationOptions) -> None:
    """Refuse what cannot be done before anything is.

    Raises:
        ValueError: If an option is out of its range; the message names it.
    """
    for name, (lowest, highest) in _RANGES.items():
        value = getattr(options, name)
        if value is not None and not lowest <= value <= highest:
            raise ValueError(f"{name}={value}: at least {lowest} and at most {highest:,}.")
    for key, limit in options.cost_limits.items():
        if not 0 <= limit < math.inf:
            raise ValueError(f"cost_limits.{key}={limit}: it must be a number from 0.")
    check_share(options.cvar_alpha)
    if options.certificate and not options.certify:
        raise ValueError("certificate.…: it is the certificate's: add certify=true.")
    if "/" in options.name or not options.name.isprintable():
        raise ValueError(f"name={options.name}: it is part of the files' names, without /.")
    films = options.video or options.picture
    if options.variations is not None and (films or options.record or options.certify):
        raise ValueError(
            "variations=… cannot be combined with video=true, picture=…, record=true or "
            "certify=true: leave them out."
        )
    if not films and options.camera != EvaluationOptions.camera:
        raise ValueError(f"camera={options.camera}: it is the video's: add video=true.")
    if options.picture is not None:
        _check_picture(Path(options.picture))
    check_device(options.device)


def _check_picture(path: Path) -> None:
    if path.suffix not in _PICTURES:
        raise ValueError(f"picture={path}: its name must end in {' or '.join(_PICTURES)}.")
    if not path.parent.is_dir():
        raise ValueError(f"picture={path}: there is no folder {path.parent}.")


def check_device(device: str) -> None:
    """Refuse devices that networks cannot be on, here or anywhere.

    Raises:
        ValueError: If there is none of the name.

    Examples:
        >>> check_device("cpu")
    """
    import torch  # here, because help and configurations are shown without it

    try:
        kind, index = torch.device(device).type, torch.device(device).index or 0
    except RuntimeError:
        kind, index = "", 0
    if kind not in ("cpu", "cuda"):
        raise ValueError(f"device={device}: it must be cpu, cuda or cuda:<number>.")
    if kind == "cuda" and index >= torch.cuda.device_count():
        raise ValueError(f"device={device}: torch finds {torch.cuda.device_count()} CUDA devices.")
