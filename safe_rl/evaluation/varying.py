"""A trained policy under variations of its environment: return and cost under each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig
from torchrl.envs import EnvBase

from safe_rl.evaluation.episodes import Episodes, collect_episodes, default_seed
from safe_rl.evaluation.loading import (
    find_checkpoint,
    for_evaluation,
    limits_of,
    load_config,
    load_policy,
    override_env,
    without_cost,
)
from safe_rl.evaluation.settings import EvaluationOptions, check_options
from safe_rl.evaluation.summary import check_places, summarise
from safe_rl.evaluation.variations import TransformNode, Variation, varied
from safe_rl.files import replace_csv
from safe_rl.runs.folder import RunFolder, checkpoint_steps
from safe_rl.scores.comparisons import Estimate

__all__ = ["AS_TRAINED", "Varied", "VariedRow", "evaluate_variations"]

AS_TRAINED = Variation("as trained", None, {})


class VariedRow(NamedTuple):
    """What was found under a variation.

    Attributes:
        variation: What was changed; `AS_TRAINED` for nothing.
        estimates: As :func:`safe_rl.evaluation.summary.summarise` returns them.
    """

    variation: Variation
    estimates: Mapping[str, Estimate]


@dataclass(frozen=True)
class Varied:
    """What an evaluation under variations found.

    Attributes:
        rows: First the environment as trained on, then every variation.
        left_out: Variations that this environment cannot have, and why.
        cost_limits: Cost key -> d, of the environment as trained on.
        facts: Of what, for the terminal.
        file: The table.
    """

    rows: tuple[VariedRow, ...]
    left_out: tuple[tuple[Variation, str], ...]
    cost_limits: Mapping[str, float]
    facts: Mapping[str, Any]
    file: Path


def evaluate_variations(
    directory: Path,
    options: EvaluationOptions,
    variations: Sequence[Variation],
    *,
    make_env: Callable[..., EnvBase],
    transform_node: TransformNode,
    refusals: tuple[type[Exception], ...],
    may_lack: Callable[[Variation], bool],
    progress: bool = False,
) -> Varied:
    """Run a trained policy in its own environment and in variations of it.

    All of them draw from the same seed, so that what differs between them is not luck.

    Args:
        directory: Folder of a run.
        options: As for an evaluation; ``env`` changes every one of the environments.
        variations: What is changed.
        make_env: ``make_env(node, num_envs=, device=, seed=, num_threads=)``.
        transform_node: Name of a transform -> its node, for those that the run lacks.
        refusals: What an environment raises that cannot have a variation, beside ValueError.
        may_lack: Whether a variation is left out where the environment cannot have it.
        progress: Whether to say what is next.

    Raises:
        FileNotFoundError: If the folder is not a run's, or has no such checkpoint.
        OSError: If what it finds cannot be written, which is seen before any episode.
        CheckpointError: If the policy does not fit a varied environment.
        ValueError: If an environment cannot have a variation that was asked for by itself.
    """
    check_options(options)
    config = load_config(directory)
    config.env = override_env(config, options.env)
    checkpoint = find_checkpoint(directory, options.checkpoint)
    file = RunFolder(directory).variations(options.name, "csv")
    check_places([file, RunFolder(directory).variations(options.name, "png")])
    rows: list[VariedRow] = []
    trained_limits: dict[str, float] = {}
    lost: dict[str, float] = {}
    left_out: list[tuple[Variation, str]] = []
    cannot: tuple[type[Exception], ...] = (ValueError, *refusals)
    for variation in (AS_TRAINED, *variations):
        try:
            changed = varied(config, variation, transform_node) if variation.keys else config
            if changed is None:
                left_out.append((variation, "it would be as it was trained"))
                continue
            if progress:
                print(f"… {variation}", flush=True)
            episodes = _episodes(changed, checkpoint, options, make_env)
        except cannot as error:
            if variation is AS_TRAINED or not may_lack(variation):
                raise
            left_out.append((variation, str(error)))
            continue
        limits = limits_of(config, options.cost_limits, episodes.costs)
        if not rows:
            trained_limits, lost = limits, without_cost(config, episodes.costs)
        rows.append(VariedRow(variation, summarise(episodes, limits, None, options.cvar_alpha)))
    _write(file, rows)
    facts = {"algorithm": config.algo.name, "environment": config.env.get("name", "")}
    facts |= {"steps": checkpoint_steps(checkpoint), "episodes": options.episodes}
    facts["limits_without_cost"] = lost
    return Varied(tuple(rows), tuple(left_out), trained_limits, facts, file)


def _episodes(
    config: DictConfig, checkpoint: Path, options: EvaluationOptions, make_env: Any
) -> Episodes:
    node = override_env(config, {})
    seed = default_seed(node, config.seed) if options.seed is None else options.seed
    env = for_evaluation(make_env, config)(
        node,
        num_envs=min(options.num_envs, options.episodes),
        device=options.device,
        seed=seed,
        num_threads=options.num_threads,
    )
    with closing(env):
        policy = load_policy(config, env, checkpoint, torch.device(options.device))
        torch.manual_seed(seed)
        return collect_episodes(
            env, policy, options.episodes, env.cost_keys, deterministic=options.deterministic
        )


def _write(path: Path, rows: Sequence[VariedRow]) -> None:
    """A row per variation: what was changed to what, and every estimate with its interval.

    Nothing stands where a variation has not the cost of another one.
    """
    names = list(dict.fromkeys(name for row in rows for name in row.estimates))
    columns = [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
    table: list[list[Any]] = [["variation", "row", "value", "keys", *columns]]
    for variation, estimates in rows:
        row, value, keys = variation
        changes = " ".join(f"{key}={changed}" for key, changed in keys.items())
        found = [number for name in names for number in estimates.get(name, ("", "", ""))]
        table.append([str(variation), row, "" if value is None else value, changes, *found])
    replace_csv(path, table)
