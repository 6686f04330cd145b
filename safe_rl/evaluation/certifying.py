"""The certificate of a run: which of its checkpoints keeps the limits, with which confidence."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from safe_rl.checks import is_device, is_number
from safe_rl.evaluation.certificate import Certificate
from safe_rl.evaluation.episodes import Episodes, collect_episodes, has_fixed_layout
from safe_rl.evaluation.loading import maker_of
from safe_rl.evaluation.measuring import PolicyEvaluation
from safe_rl.evaluation.policies import writable_copy
from safe_rl.evaluation.settings import (
    CertificateOptions,
    EvaluationOptions,
    certificate_options,
)
from safe_rl.files import read_json, replace_json, replacing
from safe_rl.runs.checkpoints import policy_hash
from safe_rl.runs.folder import checkpoint_steps, lock_folder
from safe_rl.runs.run import Run
from safe_rl.scores.certificate import Claim, Verdict, error_of_next_test, first_certified, rank

# number of environments that are stepped together, and of episodes between two checks of a test;
# MuJoCo Warp takes nearly the same time for a thousand environments as for a hundred
_BATCH, _BATCH_OF_WARP = 100, 1_000
# Added to the seed of the run. They differ by 1e11: no test of a run has the episodes of another
# run's ranking while the difference of their seeds plus 1e6 times the number of batches is less.
_RANKING, _TEST, _AFTER = 100_000_000_003, 200_000_000_041, 300_000_000_077
_OF_EXPORTED = 50_000_000_021  # of an exported policy, which the tests of its run have chosen
# of two batches, which have new instances of the environment; of two tests of a run
_NEXT_BATCH, _NEXT_TEST = 1_000_003, 1_000_000_000_039
_ROUNDS = (0.25, 0.25, 0.5)  # shares of the ranking's episodes in its rounds


def certify_run(
    directory: Path | str,
    *,
    num_threads: int = 0,
    changes: Mapping[str, Any] | None = None,
    deterministic: bool = False,
) -> Certificate | None:
    """`certify` with some keys of the section ``certificate`` changed, under the run's lock.

    A policy of the package is copied into the working directory.

    Raises:
        RunInUseError: If another process writes into the folder.
        ValueError: If there is no such key, or it cannot have the value.
    """
    run = Run(writable_copy(Path(directory)))
    asked = {**(changes or {}), **({"deterministic": True} if deterministic else {})}
    options = certificate_options(run.config, asked)
    with lock_folder(run.lock_file):  # an unwritable folder is found before hours of tests
        return certify(run.directory, options, num_threads=num_threads, progress=True)


def certify(
    directory: Path,
    options: CertificateOptions,
    *,
    make_env: Callable[..., EnvBase] | None = None,
    num_threads: int = 0,
    progress: bool = False,
) -> Certificate | None:
    """Find and certify the best checkpoint of a run that keeps its limits.

    All checkpoints are ranked by some episodes; the first ones are tested on new episodes. The
    result is written to ``certificate.json``, and the policy is saved as ``checkpoint=certified``.
    The level is that of all tests of the run together: each spends a part of the error, which the
    run's folder keeps. The same test of the same checkpoints is repeated, and spends nothing. If no
    test of so few episodes can succeed, none is made, and the folder stays as it is.

    Args:
        directory: Folder of the run.
        options: Options of the test, such as the number of episodes.
        make_env: As in `safe_rl.evaluation.evaluate`.
        num_threads: Threads that step environments; 0 is one per core.
        progress: Whether to show a bar.

    Returns:
        The certificate; None if the run has no limits or no checkpoints.

    Raises:
        ValueError: If earlier tests of the run have spent more error than the level allows.
    """
    run = Run(directory)
    config, limits = run.config, run.cost_limits
    candidates = _candidates(run)
    if not limits or not candidates:
        return None
    # the device of training, where the simulation may run, if this machine has it
    device = next(filter(is_device, (config.device, "cuda", "cpu")))
    plain = EvaluationOptions(
        device=device, num_threads=num_threads, deterministic=options.deterministic
    )
    make = make_env or maker_of(run)
    evaluations = [PolicyEvaluation(config, path, plain, make) for path in candidates]
    claimed = ("most_over", "cap", "most_beyond", "tail")
    claim = Claim(limits, **{name: getattr(options, name) for name in claimed})
    number, error, noted = _next_test(run, options, candidates)
    claim = replace(claim, level=1 - error)
    order, claims = _ranked(evaluations, claim, options, progress)
    seed = _TEST + (number - 1) * _NEXT_TEST + (0 if run.has_begun else _OF_EXPORTED)
    # they share the error; how many there are is known before the first episode of the test
    tests = min(options.tests, len(candidates))
    fewest = min(claims[candidate].fewest(tests) for candidate in order[:tests])
    if fewest > options.episodes:
        return Certificate(None, math.nan, Verdict(None, []), options, test=number, fewest=fewest)
    replace_json(run.tests_file, noted)  # the error is spent before the first episode of the test

    def collect(candidate: int) -> Iterator[dict[str, np.ndarray]]:
        tested = evaluations[candidate]
        batch = min(options.episodes, _batch_of(tested))
        for _, (episodes,) in _run([tested], seed, options.episodes, batch, progress):
            yield _costs(episodes)

    verdict = first_certified(order, collect, claims, tests, options.episodes)
    certificate = Certificate(None, math.nan, verdict, options, test=number, fewest=fewest)
    if (chosen := verdict.certified) is not None:
        # episodes of the test have decided when it ended: it ends when costs happen to be low
        batch, later = _batch_of(evaluations[chosen]), seed - _TEST + _AFTER
        _, (after,) = next(_run([evaluations[chosen]], later, batch, batch, progress))
        statements = claims[chosen].statements(_costs(after))
        certificate = replace(
            certificate,
            checkpoint=_keep(run, candidates[chosen]),
            episode_return=after.returns.mean().item(),
            means={item.name: float(item.values.mean()) for item in statements},
            further=len(after.returns),
        )
    _write(run, certificate, [checkpoint_steps(path) for path in candidates])
    _remove_earlier(run, certificate.checkpoint)
    return certificate


def _next_test(
    run: Run, options: CertificateOptions, candidates: Sequence[Path]
) -> tuple[int, float, list[dict[str, Any]]]:
    """Number and error probability of a test, and the notes on all tests of its run with it."""
    tests = read_json(run.tests_file) if run.tests_file.is_file() else []
    is_list = isinstance(tests, list) and all(isinstance(former, dict) for former in tests)
    if not is_list or not all(is_number(former.get("error")) for former in tests):
        raise ValueError(f"{run.tests_file} is not as a run writes it: restore it.")
    test: dict[str, Any] = {"options": asdict(options), "limits": run.cost_limits}
    test["candidates"] = [path.name for path in candidates]
    for number, former in enumerate(tests, 1):
        if all(former.get(key) == value for key, value in test.items()):
            return number, former["error"], tests
    spent = [former["error"] for former in tests]
    error = error_of_next_test(options.level, spent)
    if error <= 0:
        raise ValueError(
            f"level={options.level:g}: earlier tests of this run have spent an error of "
            f"{sum(spent):.3g}. All of its tests together can have a level below "
            f"{1 - sum(spent):.5g}: certificate.level={1 - 2 * sum(spent):.3g}"
        )
    return len(tests) + 1, error, [*tests, {**test, "error": error}]


def _ranked(
    evaluations: Sequence[PolicyEvaluation],
    claim: Claim,
    options: CertificateOptions,
    progress: bool,
) -> tuple[list[int], list[Claim]]:
    """Order candidates for the tests; returns their numbers, and the claim about each of them.

    In every round the worse half of the candidates is given up (successive halving), as long as
    more are left than can be tested. A simulation that all of them share has one round.
    """
    together = _has_warp(evaluations[0])
    rounds = [options.ranking]
    if not together and options.ranking >= 4 / min(_ROUNDS) and len(evaluations) > options.tests:
        rounds = [int(share * options.ranking) for share in _ROUNDS]
        rounds[-1] = options.ranking - sum(rounds[:-1])
    episodes_of: list[list[Episodes]] = [[] for _ in evaluations]
    order, left = list(range(len(evaluations))), len(evaluations)
    for part, number in enumerate(rounds):
        seed, tried = _RANKING + part * _NEXT_BATCH, order[:left]
        for group in [tried] if together else [[candidate] for candidate in tried]:
            ranked = [evaluations[candidate] for candidate in group]
            highest, episodes = next(_run(ranked, seed, number, number, progress))
            for candidate, batch in zip(group, episodes, strict=True):
                episodes_of[candidate].append(batch)
        claim = replace(claim, highest=highest)
        costs = [_costs(*parts) for parts in episodes_of]
        claims = [claim.with_thresholds(of_candidate) for of_candidate in costs]
        returns = [torch.cat([part.returns for part in parts]).numpy() for parts in episodes_of]
        places = rank(
            [returns[c] for c in tried], [costs[c] for c in tried], [claims[c] for c in tried]
        )
        order[:left] = [tried[place] for place in places]
        left = max(options.tests, -(-left // 2))
    return order, claims


def _costs(*parts: Episodes) -> dict[str, np.ndarray]:
    return {key: np.concatenate([part.costs[key] for part in parts]) for key in parts[0].costs}


def _candidates(run: Run) -> list[Path]:
    """Checkpoints, best and last ones, by ascending steps, one for every number of steps.

    An exported policy has none of these kinds, only its certified one.
    """
    kinds = (run.checkpoints(kind) for kind in ("best", "last"))
    by_name = {path.name: path for paths in kinds for path in paths}
    return [by_name[name] for name in sorted(by_name)] or run.checkpoints("certified")


def _has_warp(evaluation: PolicyEvaluation) -> bool:
    return evaluation.node.get("physics") == "warp"


def _batch_of(evaluation: PolicyEvaluation) -> int:
    """Number of episodes that a test runs at a time."""
    return _BATCH_OF_WARP if _has_warp(evaluation) else _BATCH


def _run(
    evaluations: list[PolicyEvaluation], seed_offset: int, number: int, batch: int, progress: bool
) -> Iterator[tuple[dict[str, float], list[Episodes]]]:
    """`number` episodes per checkpoint, `batch` at a time, with seeds that nothing else uses.

    A round of the ranking is one batch. In a batch of a test every environment has one episode, so
    short episodes do not count before long ones. Every batch has new instances of the environment:
    episodes of one instance are not independent if it draws constants when it is made. Only a fixed
    layout, which is such a constant, is kept, and all else drawn anew. Checkpoints of one call
    share one simulation; those of several calls have the same layouts. Costs come with the highest
    possible ones of an episode.
    """
    evaluation, together = evaluations[0], len(evaluations)
    run_seed, is_fixed = evaluation.seed, has_fixed_layout(evaluation.node)
    worlds = batch if together > 1 else min(number, _batch_of(evaluation))
    keys = list(evaluation.config.cost_limits)
    torch.manual_seed(run_seed + seed_offset)
    with ExitStack() as stack, tqdm(total=number, disable=None if progress else True) as bar:
        for part in range(math.ceil(number / batch)):
            if part == 0 or not is_fixed:
                stack.close()
                seed = run_seed + seed_offset + part * _NEXT_BATCH
                env = evaluation.make(worlds * together, run_seed if is_fixed else seed)
                stack.enter_context(closing(env))
                if is_fixed:
                    _seed_without_layout(env, seed)
                policy = _side_by_side([each.policy(env) for each in evaluations])
                highest = {key: env.highest_cost(key) for key in keys}
            collected = collect_episodes(
                env, policy, batch * together, keys, deterministic=evaluation.options.deterministic
            )
            # sorted by environment, so those of a checkpoint follow each other
            columns = [collected.returns, collected.lengths, *collected.costs.values()]
            parts = zip(*(column.chunk(together) for column in columns), strict=True)
            found = [
                Episodes(returns, lengths, dict(zip(keys, costs, strict=True)))
                for returns, lengths, *costs in parts
            ]
            yield highest, found
            bar.update(batch)


def _seed_without_layout(env: EnvBase, seed: int) -> None:
    """Seed all draws of an environment except for its fixed layout, if its state has one."""
    state = env.get_state()
    if state is not None and "fixed_layout" in state:
        env.set_seed(seed)
        env.set_state(env.get_state().set("fixed_layout", state["fixed_layout"]))


def _side_by_side(policies: list[TensorDictModuleBase]) -> Callable[..., TensorDictBase]:
    """Let each policy act in an equal share of the environments."""

    def act(state: TensorDictBase) -> TensorDictBase:
        shares = zip(policies, state.chunk(len(policies)), strict=True)
        return torch.cat([policy(share) for policy, share in shares])

    return policies[0] if len(policies) == 1 else act


def _keep(run: Run, checkpoint: Path) -> Path:
    """Copy the certified checkpoint to a file that is not overwritten by later ones."""
    kept = run.checkpoints_folder / "certified" / checkpoint.name
    kept.parent.mkdir(parents=True, exist_ok=True)
    with replacing(kept) as unfinished:
        shutil.copy2(checkpoint, unfinished)
    return kept


def _remove_earlier(run: Run, kept: Path | None) -> None:
    """Remove earlier certified checkpoints, once the new certificate is complete.

    Until then the old certificate has its policy: copying one with a replay buffer takes long
    enough to be interrupted.
    """
    earlier = [path for path in run.checkpoints("certified") if path != kept]
    if earlier and kept is None and not (run.checkpoints("best") or run.checkpoints("last")):
        # an exported policy's only weights
        earlier[0].parent.rename(run.checkpoints_folder / "last")
        return
    for path in earlier:
        path.unlink()


def _write(run: Run, certificate: Certificate, candidates: list[int | None]) -> None:
    verdict, options, kept = certificate.verdict, certificate.options, certificate.checkpoint
    content = asdict(verdict) | asdict(options)
    content |= {
        "bound": "betting",  # a file without it is of an earlier version, by Student's bound
        "certified": kept is not None,
        "checkpoint": None if kept is None else kept.name,
        "policy_sha256": None if kept is None else policy_hash(kept),
        "episode_return": certificate.episode_return,
        "means": dict(certificate.means),
        "further_episodes": certificate.further,
        "test": certificate.test,
        "bounds": {
            name: {"bound": bound, "most": most} for name, (bound, most) in verdict.bounds.items()
        },
        "candidates": candidates,
        "tested": [candidates[number] for number in verdict.tested],
        "episodes": verdict.episodes,
        "most_episodes": options.episodes,
    }
    replace_json(run.certificate_file, content)
