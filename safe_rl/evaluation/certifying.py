"""The certificate of a run: which of its checkpoints keeps the limits, and how surely."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase

from safe_rl.evaluation.episodes import Episodes, collect_episodes, default_seed, has_fixed_layout
from safe_rl.evaluation.loading import for_evaluation, load_config, load_policy, override_env
from safe_rl.files import check_no_links, replace_text, replacing
from safe_rl.runs.folder import RunFolder, checkpoint_steps, checkpoints_in
from safe_rl.scores.certificate import Claim, Verdict, first_certified, rank

__all__ = ["Certificate", "CertificateOptions", "certify"]

# worlds that are stepped together at most: more of them only take memory
_MOST_WORLDS = 100


@dataclass(frozen=True, kw_only=True)
class CertificateOptions:
    """What is certified and by how many episodes: the section ``certificate`` of a configuration.

    Attributes:
        ranking: Episodes of every candidate by which candidates are put in order.
        episodes: Fresh episodes of every candidate that is tested.
        tests: Candidates tested at most.
        retest: Where all of them fall short, one is tested once more, on so many times the
            episodes; 0 for no such test.
        level: Confidence of the statement, in (0.5, 1).
        most_over: Largest share of episodes that may cost more than a limit; 1 asks for nothing.
    """

    ranking: int
    episodes: int
    tests: int
    level: float
    most_over: float
    retest: int = 0


@dataclass(frozen=True)
class Certificate:
    """The result of certifying a run.

    Attributes:
        checkpoint: The policy that is certified, or None.
        episode_return: Its mean return in the test.
        verdict: Bounds, tests and shortfalls.
        options: What was asked for.
    """

    checkpoint: Path | None
    episode_return: float
    verdict: Verdict
    options: CertificateOptions

    def __str__(self) -> str:
        """One line for the terminal."""
        level = f"at {100 * self.options.level:.12g}%"
        if self.checkpoint is None:
            missing = ", ".join(f"{n} by {v:.3g}" for n, v in self.verdict.shortfalls.items())
            return (
                f"Not certified {level}: no checkpoint's bound is within its limit ({missing})."
                f"{_unseen(self.verdict)}"
            )
        bounds = ", ".join(f"{n} ≤ {b:.3g}" for n, (b, _) in self.verdict.bounds.items())
        steps = checkpoint_steps(self.checkpoint)
        return f"Certified {level}: {bounds}, return {self.episode_return:.2f}, at {steps:,} steps."


def _unseen(verdict: Verdict) -> str:
    """What to say of a test all of whose episodes cost the same; nothing of another one."""
    if not verdict.alike:
        return ""
    said = f" All tested episodes had the same {', '.join(verdict.alike)}: the bound is "
    if all(math.isfinite(bound) for bound, _ in verdict.bounds.values()):
        return said + (
            "what unseen ones may cost at most, and no number of episodes brings it down to 0."
        )
    return said + (
        "what unseen ones may cost at most, and the environment's spec does not say what that is. "
        "Give the cost's spec an upper bound (Bounded instead of Unbounded); in Safety Gym's "
        "environments env.constrain_indicator=true makes it 1 a step."
    )


def certify(
    directory: Path,
    options: CertificateOptions,
    *,
    make_env: Callable[..., EnvBase],
    num_threads: int = 0,
    progress: bool = False,
) -> Certificate | None:
    """Find and certify the best checkpoint of a run that keeps its limits.

    All checkpoints are ranked by episodes of their own; the first of them are tested on fresh ones,
    and the one that falls short least, if all do, on more.
    The result is written to ``certificate.json``, the policy kept as ``checkpoint=certified``.

    Args:
        directory: Folder of the run.
        options: What to certify, and by how many episodes.
        make_env: ``make_env(node, num_envs=, device=, seed=, num_threads=)``.
        num_threads: Threads that step environments; 0 is one per core.
        progress: Whether to show a bar.

    Returns:
        The certificate; None if the run has no limits or no checkpoints.
    """
    config = load_config(directory)
    folder = RunFolder(directory)
    check_no_links(directory)
    candidates = _candidates(folder)
    limits = {key: float(limit) for key, limit in config.cost_limits.items()}
    if not limits or not candidates:
        return None
    runner = _Runner(config, make_env, num_threads, progress)
    first = [runner.run(path, options.ranking, purpose=0) for path in candidates]
    claim = Claim(limits, options.most_over, options.level, runner.largest)
    order = rank([e.returns.numpy() for e in first], [_costs(e) for e in first], claim)
    returns: dict[int, float] = {}

    def collect(number: int, episodes: int, purpose: int) -> dict[str, np.ndarray]:
        found = runner.run(candidates[number], episodes, purpose)
        returns[number] = found.returns.mean().item()
        return _costs(found)

    verdict = first_certified(
        order,
        partial(collect, episodes=options.episodes, purpose=1),
        claim,
        options.tests,
        partial(collect, episodes=options.retest * options.episodes, purpose=2)
        if options.retest
        else None,
    )
    kept = None if verdict.certified is None else candidates[verdict.certified]
    episode_return = math.nan if verdict.certified is None else returns[verdict.certified]
    certificate = Certificate(_keep(folder, kept), episode_return, verdict, options)
    _write(folder, certificate, [checkpoint_steps(path) for path in candidates])
    return certificate


def _costs(episodes: Episodes) -> dict[str, np.ndarray]:
    return {key: costs.numpy() for key, costs in episodes.costs.items()}


def _candidates(folder: RunFolder) -> list[Path]:
    """Checkpoints of all kinds by ascending steps, one for every number of steps."""
    found = {
        checkpoint_steps(path): path
        for kind in ("best", "last")
        for path in checkpoints_in(folder.checkpoints / kind)
    }
    return [found[steps] for steps in sorted(found, key=lambda steps: steps or 0)]


class _Runner:
    """Runs policies on episodes that neither training nor another purpose has seen."""

    def __init__(
        self, config: DictConfig, make_env: Callable[..., EnvBase], threads: int, progress: bool
    ) -> None:
        self._config, self._make_env = config, for_evaluation(make_env, config)
        self._threads, self._progress = threads, progress
        self.largest: dict[str, float] = {}

    def run(self, checkpoint: Path, number: int, purpose: int) -> Episodes:
        node = override_env(self._config, {})
        # of all candidates the same layouts: what differs between them is not luck
        seed = default_seed(node, self._config.seed)
        fresh = seed + 1 + purpose
        env = self._make_env(
            node,
            num_envs=min(number, _MOST_WORLDS),
            device="cpu",
            seed=seed if has_fixed_layout(node) else fresh,
            num_threads=self._threads,
        )
        policy = load_policy(self._config, env, checkpoint, torch.device("cpu"))
        torch.manual_seed(fresh)
        keys = list(self._config.cost_limits)
        self.largest = {key: _largest_cost(env, key) for key in keys}
        try:
            return collect_episodes(
                env, policy, number, keys, deterministic=False, progress=self._progress
            )
        finally:
            env.close()


def _largest_cost(env: EnvBase, key: str) -> float:
    """The most that an episode can cost: its steps times the upper bound of one in the spec."""
    spec = env.full_reward_spec[key]
    if not hasattr(spec, "high"):
        return math.inf
    highest = float(spec.high.max())
    # the largest number that there is stands for no bound
    is_bounded = highest < torch.finfo(torch.float32).max
    return highest * float(env.max_episode_steps) if is_bounded else math.inf


def _keep(folder: RunFolder, checkpoint: Path | None) -> Path | None:
    """Copy the certified checkpoint to where no other takes its place.

    That of an earlier certificate goes when the copy is complete: with its replay buffer one takes
    long enough to be interrupted.
    """
    directory = folder.checkpoints / "certified"
    if checkpoint is None:
        shutil.rmtree(directory, ignore_errors=True)
        return None
    directory.mkdir(parents=True, exist_ok=True)
    kept = directory / checkpoint.name
    with replacing(kept) as unfinished:
        shutil.copy2(checkpoint, unfinished)
    for other in directory.iterdir():
        if other != kept:
            other.unlink()
    return kept


def _finite(value: float) -> float | None:
    """A number as JSON has it, which knows no infinity."""
    return value if math.isfinite(value) else None


def _write(folder: RunFolder, certificate: Certificate, candidates: list[int | None]) -> None:
    verdict = certificate.verdict
    content: Mapping[str, Any] = {
        "certified": certificate.checkpoint is not None,
        "checkpoint": None if certificate.checkpoint is None else certificate.checkpoint.name,
        "episode_return": None if verdict.certified is None else certificate.episode_return,
        "bounds": {
            name: {"bound": _finite(bound), "most": most}
            for name, (bound, most) in verdict.bounds.items()
        },
        "shortfalls": {name: _finite(value) for name, value in verdict.shortfalls.items()},
        "alike": verdict.alike,
        "candidates": candidates,
        "tested": [candidates[number] for number in verdict.tested],
        **asdict(certificate.options),
    }
    replace_text(folder.certificate, json.dumps(content, indent=2) + "\n")
