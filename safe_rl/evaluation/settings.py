"""Options of an evaluation and of a certificate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from annotated_types import Interval
from omegaconf import DictConfig, OmegaConf
from pydantic import NonNegativeFloat, PositiveFloat

from safe_rl.checks import (
    CheckedOptions,
    Device,
    Fraction,
    SettingError,
    Share,
    check_value,
    option,
    rule,
)
from safe_rl.files import CONF
from safe_rl.naming import did_you_mean

PICTURES = ("gif", "webp")
"""Suffixes of animated pictures."""
_PICTURE = rule(
    lambda v: Path(v).suffix[1:] in PICTURES, f"a file ending in .{' or .'.join(PICTURES)}"
)
_Threads = Annotated[int, Interval(ge=0, le=1024)]
_NAME = rule(lambda v: "/" not in v and v.isprintable(), "a part of files' names, without /")


@dataclass
class EvaluationOptions(CheckedOptions):
    """Options of ``safe-rl evaluate``; the help texts say what they mean."""

    episodes: Annotated[int, Interval(ge=1, le=10**8)] = option(100, "whole episodes to run")
    checkpoint: str = option(
        "last", "last, best (highest return that kept every limit), certified, or a path"
    )
    deterministic: bool = option(False, "act with the policy's mean instead of sampling from it")
    seed: Annotated[int, Interval(ge=0, le=2**62)] | None = option(
        None, "seed of layouts and actions; null: one that training never used"
    )
    # with upper bounds, because memory and the number of threads are limited
    num_envs: Annotated[int, Interval(ge=1, le=100_000)] = option(
        25, "environments that are stepped together"
    )
    num_threads: _Threads = option(0, "threads that step them; 0: one per core")
    device: Device = option("cpu", "where the policy acts: cpu or cuda")
    cvar_alpha: Fraction = option(0.1, "share of the costliest episodes in the CVaR")
    video: bool = option(False, "write an MP4 of an episode from the first layout (extra 'video')")
    picture: Annotated[str, _PICTURE] | None = option(
        None, "file for an animated picture of that episode, .gif or .webp"
    )
    camera: str = option("free", "of the video: free, fixednear, fixedfar, track or vision")
    record: bool = option(False, "write every transition to disk, for dataset.path=…")
    cost_limits: dict[str, NonNegativeFloat] = option(
        dict, "limits to use instead of the run's own, such as '{cost: 10}'"
    )
    name: Annotated[str, _NAME] = option(
        "", "suffix of the files, to keep several evaluations of a run"
    )
    env: dict[str, Any] = option(
        dict, "keys of the environment, as in training: env.hazards_num=12"
    )


@dataclass
class CertifyOptions(CheckedOptions):
    """Options of ``safe-rl certify``; the help texts say what they mean."""

    certificate: dict[str, Any] = option(
        dict, "certificate.episodes=2000 and so on, as in training; else the run's own"
    )
    deterministic: bool = option(False, "certify the policy's mean actions; else sampled ones")
    num_threads: _Threads = option(0, "threads that step environments; 0: one per core")


@dataclass(frozen=True, kw_only=True)
class CertificateOptions:
    """What is certified and by how many episodes: the section ``certificate`` of a configuration.

    Attributes:
        ranking: Number of episodes per candidate by which candidates are ranked.
        episodes: Largest number of new episodes in each test; 0: no certificate.
        tests: Largest number of candidates that are tested.
        level: Confidence of a certificate.
        most_over: Share of episodes that may cost more than a limit; 1: no bound on this share.
        cap: Cost up to which an episode counts, above all limits; null: all, if costs are bounded.
        most_beyond: Share of episodes that may cost more than the cap.
        tail: Share of the costliest episodes whose mean is limited (CVaR); 1: all episodes.
        deterministic: Whether the policy acts with its mean actions; else it samples them.
    """

    ranking: Annotated[int, Interval(ge=2, le=10**6)]
    episodes: Annotated[int, Interval(ge=0, le=10**6)]
    tests: Annotated[int, Interval(ge=1, le=1000)]
    level: Annotated[float, Interval(gt=0.5, lt=1)]
    most_over: Share
    cap: PositiveFloat | None = None
    most_beyond: Share = 0.01
    tail: Fraction = 1.0
    deterministic: bool = False


def has_tested_measure(config: DictConfig) -> bool:
    """Whether a certificate can be about what is limited: not a risk measure of the user's own."""
    target = OmegaConf.select(config, "risk._target_")
    return target is None or str(target).startswith("safe_rl.")


def certificate_options(
    config: DictConfig, changes: Mapping[str, Any] | None = None
) -> CertificateOptions:
    """The options of a run's certificate, from its sections ``certificate`` and ``risk``.

    With ``risk=chance`` the share of episodes above the limit is certified as well; with
    ``risk=cvar`` the mean cost of the costliest episodes.
    """
    kinds = get_type_hints(CertificateOptions, include_extras=True)
    # runs of earlier versions may have further keys
    options = {name: value for name, value in config.certificate.items() if name in kinds}
    for name, value in (changes or {}).items():
        if name not in kinds:
            raise ValueError(f"There is no certificate.{name}.{did_you_mean(name, kinds)}")
        options[name] = check_value(f"certificate.{name}", kinds[name], value)
    if changes and changes.get("episodes") == 0:
        raise SettingError("certificate.episodes=0: a test needs episodes.")
    if not options["episodes"]:  # training was to end without a certificate
        options["episodes"] = OmegaConf.load(CONF / "config.yaml").certificate.episodes
    # with risk=mean the section may still have numbers, such as the tail of WCSAC's critics
    is_measured = OmegaConf.select(config, "risk._target_") and has_tested_measure(config)
    risk = config.risk if is_measured else {}
    share = min(options["most_over"], risk.get("most_over", 1.0))
    return CertificateOptions(**options | {"most_over": share}, tail=risk.get("tail", 1.0))
