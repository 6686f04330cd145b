"""The certificate of a run: which of its checkpoints keeps the limits, with which confidence."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from safe_rl.evaluation.episodes import Episodes, collect_episodes, has_fixed_layout
from safe_rl.evaluation.measuring import Trial
from safe_rl.evaluation.settings import CertificateOptions, EvaluationOptions
from safe_rl.files import check_no_links, replace_json, replacing
from safe_rl.runs.folder import checkpoint_steps
from safe_rl.runs.run import Run
from safe_rl.scores.bounds import rounded_up
from safe_rl.scores.certificate import Claim, Verdict, first_certified, rank

# number of environments that are stepped together, and of episodes between two checks of a test;
# MuJoCo Warp takes nearly the same time for a thousand environments as for a hundred
_BATCH, _BATCH_OF_WARP = 100, 1_000
# added to the seed: so far apart that no test of a run has the episodes of another run's ranking
_RANKING, _TEST = 100_000_000_003, 200_000_000_041


@dataclass(frozen=True)
class Certificate:
    """The result of certifying a run.

    Attributes:
        checkpoint: The policy that is certified, or None.
        episode_return: Its mean return in the test.
        verdict: Bounds, tests and shortfalls.
        options: Options of the test.
    """

    checkpoint: Path | None
    episode_return: float
    verdict: Verdict
    options: CertificateOptions

    def __str__(self) -> str:
        """One line: what is certified, and what the bounds do not cover."""
        actions = "mean" if self.options.deterministic else "sampled"
        level = f"at {100 * self.options.level:.12g}% with {actions} actions"
        verdict = self.verdict
        if self.checkpoint is None:
            missing = "; ".join(
                f"{name} ≤ {rounded_up(bound):.3g}, limit {most:g}, mean {verdict.means[name]:.3g}"
                for name, (bound, most) in verdict.bounds.items()
                if name in verdict.shortfalls
            )
            return (
                f"Not certified {level}: no checkpoint's bound is within its limit ({missing}; "
                f"{verdict.episodes:,} new episodes)."
            )
        shown = {name: rounded_up(bound) for name, (bound, _) in verdict.bounds.items()}
        bounds = ", ".join(f"{name} ≤ {bound:.3g}" for name, bound in shown.items())
        means = ", ".join(f"{mean:.3g}" for mean in verdict.means.values())
        return (
            f"Certified {level}: {bounds} ({means} in {verdict.episodes:,} new episodes), return "
            f"{self.episode_return:.2f}, at {checkpoint_steps(self.checkpoint):,} steps. "
            f"{self._on_rare_episodes()} Not covered: single episodes, other environments."
        )

    def _on_rare_episodes(self) -> str:
        """Text on what the bounds say about rare episodes."""
        said = []
        if capped := ", ".join(name for name in self.verdict.bounds if name.startswith("beyond_")):
            said.append(
                f"Costs beyond a cap are not counted ({capped}: the share of such episodes)."
            )
        if self.options.bound == "student":
            said.append("The bound assumes that no rare episodes cost far more than those tested.")
        if said:
            return " ".join(said)
        most = ", ".join(f"{value:,.4g}" for value in self.verdict.highest.values())
        return f"The bound includes rare episodes that cost up to {most}."


def certify(
    directory: Path,
    options: CertificateOptions,
    *,
    make_env: Callable[..., EnvBase],
    num_threads: int = 0,
    progress: bool = False,
) -> Certificate | None:
    """Find and certify the best checkpoint of a run that keeps its limits.

    All checkpoints are ranked by some episodes; the first ones are tested on new episodes. The
    result is written to ``certificate.json``, and the policy is saved as ``checkpoint=certified``.

    Args:
        directory: Folder of the run.
        options: Options of the test, such as the number of episodes.
        make_env: ``make_env(node, num_envs=, device=, seed=, num_threads=)`` makes environments.
        num_threads: Threads that step environments; 0 is one per core.
        progress: Whether to show a bar.

    Returns:
        The certificate; None if the run has no limits or no checkpoints.
    """
    run = Run(directory)
    config = run.config
    check_no_links(directory)
    candidates = _candidates(run)
    limits = {key: float(limit) for key, limit in config.cost_limits.items()}
    if not limits or not candidates:
        return None
    # the device of training, where the simulation may run; without a GPU, the CPU
    device = config.device if torch.cuda.is_available() else "cpu"
    plain = EvaluationOptions(
        device=device, num_threads=num_threads, deterministic=options.deterministic
    )
    trials = [Trial(config, path, plain, make_env) for path in candidates]
    asked = ("most_over", "level", "bound", "cap", "most_beyond", "tail")
    claim = Claim(limits, **{name: getattr(options, name) for name in asked})
    groups = [trials] if _has_warp(trials[0]) else [[trial] for trial in trials]
    first: list[Episodes] = []
    for group in groups:
        highest, found = next(_run(group, _RANKING, options.ranking, progress))
        first += found
    costs = [_costs(episodes) for episodes in first]
    claim = replace(claim, highest=highest)
    claims = [claim.with_thresholds(costs_of_one) for costs_of_one in costs]
    returns: dict[int, list[torch.Tensor]] = {}

    def collect(number: int) -> Iterator[dict[str, np.ndarray]]:
        for _, (episodes,) in _run([trials[number]], _TEST, options.episodes, progress):
            returns.setdefault(number, []).append(episodes.returns)
            yield _costs(episodes)

    order = rank([episodes.returns.numpy() for episodes in first], costs, claims)
    verdict = first_certified(order, collect, claims, options.tests, options.episodes)
    kept, episode_return = None, math.nan
    if verdict.certified is not None:
        kept = candidates[verdict.certified]
        episode_return = torch.cat(returns[verdict.certified]).mean().item()
    certificate = Certificate(_keep(run, kept), episode_return, verdict, options)
    _write(run, certificate, [checkpoint_steps(path) for path in candidates])
    return certificate


def _costs(episodes: Episodes) -> dict[str, np.ndarray]:
    return {key: costs.numpy() for key, costs in episodes.costs.items()}


def _candidates(run: Run) -> list[Path]:
    """Checkpoints, best and last ones, by ascending steps, one for every number of steps."""
    kinds = (run.checkpoints(kind) for kind in ("best", "last"))
    found = {path.name: path for paths in kinds for path in paths}
    return [found[name] for name in sorted(found)]


def _has_warp(trial: Trial) -> bool:
    return trial.node.get("physics") == "warp"


def _run(
    trials: list[Trial], purpose: int, number: int, progress: bool
) -> Iterator[tuple[dict[str, float], list[Episodes]]]:
    """Batches of episodes with seeds that neither training nor the other purpose uses, per trial.

    A purpose is a ranking or a test. A ranking is one batch. In a batch of a test every environment
    has one episode, so short episodes do not count before long ones. Trials of one call share the
    environments of one simulation; trials of several calls have the same layouts. Every batch comes
    with the highest possible costs of an episode.
    """
    trial, together = trials[0], len(trials)
    own = trial.seed  # if the layout is fixed, the seed of training
    seed = own if has_fixed_layout(trial.node) else own + purpose
    trial = replace(trial, options=replace(trial.options, seed=seed))
    most = _BATCH_OF_WARP if _has_warp(trial) else _BATCH
    batch = number if purpose == _RANKING else min(number, most)
    worlds = batch if together > 1 else min(number, most)
    keys = list(trial.config.cost_limits)
    with (
        closing(trial.make(worlds * together)) as env,
        tqdm(total=number, disable=None if progress else True) as bar,
    ):
        highest = {key: env.highest_cost(key) for key in keys}
        policy = _side_by_side([each.policy(env) for each in trials])
        torch.manual_seed(own + purpose)
        for _ in range(math.ceil(number / batch)):
            found = collect_episodes(
                env, policy, batch * together, keys, deterministic=trial.options.deterministic
            )
            # sorted by environment, so those of a trial follow each other
            columns = [found.returns, found.lengths, *found.costs.values()]
            parts = zip(*(column.chunk(together) for column in columns), strict=True)
            episodes = [
                Episodes(returns, lengths, dict(zip(keys, costs, strict=True)))
                for returns, lengths, *costs in parts
            ]
            yield highest, episodes
            bar.update(batch)


def _side_by_side(policies: list[TensorDictModuleBase]) -> Callable[..., TensorDictBase]:
    """Let each policy act in an equal share of the environments."""

    def act(state: TensorDictBase) -> TensorDictBase:
        shares = zip(policies, state.chunk(len(policies)), strict=True)
        return torch.cat([policy(share) for policy, share in shares])

    return policies[0] if len(policies) == 1 else act


def _keep(run: Run, checkpoint: Path | None) -> Path | None:
    """Copy the certified checkpoint to a file that is not overwritten by later ones.

    The checkpoint of an earlier certificate is deleted only when the copy is complete: copying a
    checkpoint with a replay buffer takes long enough to be interrupted.
    """
    directory = run.checkpoints_folder / "certified"
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


def _write(run: Run, certificate: Certificate, candidates: list[int | None]) -> None:
    verdict, options = certificate.verdict, certificate.options
    content = asdict(verdict) | asdict(options)
    content |= {
        "certified": certificate.checkpoint is not None,
        "checkpoint": None if certificate.checkpoint is None else certificate.checkpoint.name,
        "episode_return": certificate.episode_return,
        "bounds": {
            name: {"bound": bound, "most": most} for name, (bound, most) in verdict.bounds.items()
        },
        "candidates": candidates,
        "tested": [candidates[number] for number in verdict.tested],
        "episodes": verdict.episodes,
        "most_episodes": options.episodes,
    }
    replace_json(run.certificate_file, content)
