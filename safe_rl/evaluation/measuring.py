"""A trained policy measured: from a run's folder to estimates, and their files in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from safe_rl.collectors import Recording, StepRecorder
from safe_rl.evaluation.episodes import Episodes, collect_episodes, default_seed, shared_layouts
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
from safe_rl.evaluation.summary import (
    check_places,
    format_estimates,
    format_unjudged,
    summarise,
    write_episodes,
    write_summary,
)
from safe_rl.evaluation.video import check_camera, manner_of, record_episode, write_video
from safe_rl.runs.folder import RunFolder, checkpoint_steps
from safe_rl.scores.benchmark import Suite
from safe_rl.scores.comparisons import LEVEL, Estimate

__all__ = ["Evaluation", "evaluate"]

# which layouts are shown does not make it another environment
_LAYOUTS = ("layout_seeds", "layout_seeds_first")


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        facts: What was evaluated, and how: JSON-compatible.
        estimates: Name -> estimate, see :func:`safe_rl.evaluation.summary.summarise`.
        files: What was written.
    """

    facts: dict[str, Any]
    estimates: dict[str, Estimate]
    files: tuple[Path, ...]

    def __str__(self) -> str:
        """A table for the terminal."""
        facts = self.facts
        steps = "" if facts["steps"] is None else f" at {facts['steps']:,} steps"
        manner = "its mean actions" if facts["deterministic"] else "sampled actions"
        lines = [
            f"{facts['algorithm']} on {facts['environment']}{steps}: {facts['episodes']} episodes "
            f"with {manner}, {facts['layouts_trained_on']:.0%} of the layouts known from training",
            *format_estimates(self.estimates, facts["cost_limits"]),
            *format_unjudged(facts["limits_without_cost"]),
            *(f"wrote {path}" for path in self.files),
        ]
        return "\n".join(lines)


def evaluate(
    directory: Path,
    options: EvaluationOptions,
    *,
    make_env: Callable[..., EnvBase],
    suite: Suite,
    progress: bool = False,
) -> Evaluation:
    """Run a trained policy for whole episodes and write what they say into the run's folder.

    Args:
        directory: Folder of a run.
        options: What to evaluate.
        make_env: ``make_env(node, num_envs=, device=, seed=, num_threads=)`` makes environments
            from a run's ``env``, see :func:`safe_rl.envs.make_env`.
        suite: Environments with published scores.
        progress: Whether to show a bar.

    Raises:
        FileNotFoundError: If the folder is not a run's, or has no such checkpoint.
        OSError: If what it finds cannot be written, which is seen before any episode.
        CheckpointError: If the checkpoint is damaged, or does not fit the environment.
        ConfigError: If the environment does not accept an override.
        ValueError: If an option is out of its range, or the environment cannot be drawn.
    """
    check_options(options)
    config = load_config(directory)
    checkpoint = find_checkpoint(directory, options.checkpoint)
    node = override_env(config, options.env)
    seed = default_seed(node, config.seed) if options.seed is None else options.seed

    def make(num_envs: int, **keys: Any) -> EnvBase:
        threads = options.num_threads
        return for_evaluation(make_env, config)(
            node | keys, num_envs=num_envs, device=options.device, seed=seed, num_threads=threads
        )

    # environments that draw nothing unless they are told have a key for it
    drawing = {"render_mode": "rgb_array"} if "render_mode" in node else {}
    run = RunFolder(directory)
    places = {kind: run.evaluation(options.name, kind) for kind in ("json", "csv", "transitions")}
    films = [run.evaluation(options.name, "mp4")] if options.video else []
    films += [Path(options.picture)] if options.picture else []
    check_places([places["json"], places["csv"], *films])
    for film in films:
        with closing(make(1, **drawing)) as single:
            check_camera(single, options.camera, film.suffix[1:])
    with closing(make(min(options.num_envs, options.episodes))) as env:
        cost_keys = env.cost_keys
        limits = limits_of(config, options.cost_limits, cost_keys)
        policy = load_policy(config, env, checkpoint, torch.device(options.device))
        torch.manual_seed(seed)
        episodes = _collect(env, policy, options, places["transitions"], progress)
    reference = suite.reference(node, but_for=_LAYOUTS)
    estimates = summarise(episodes, limits, reference, options.cvar_alpha)
    facts = _facts(directory, config, checkpoint, options, node, seed) | {
        "cost_limits": limits,
        "limits_without_cost": without_cost(config, cost_keys),
    }
    write_summary(places["json"], facts, estimates)
    write_episodes(places["csv"], episodes)
    for film in films:
        # the first world draws the same layouts whatever the number of worlds; actions are others
        with closing(make(1, **drawing)) as single:
            torch.manual_seed(seed)
            manner = manner_of(single, film.suffix[1:])
            frames = record_episode(
                single, policy, cost_keys, deterministic=options.deterministic, manner=manner,
                camera=options.camera,
            )  # fmt: skip
            write_video(film, frames, manner)
    kept = [places["transitions"]] if options.record else []
    return Evaluation(facts, estimates, (places["json"], places["csv"], *kept, *films))


def _collect(
    env: EnvBase,
    policy: TensorDictModuleBase,
    options: EvaluationOptions,
    transitions: Path,
    progress: bool,
) -> Episodes:
    """Whole episodes; all steps on the way are written if that is wanted."""
    recorder = None
    if options.record:
        recorder = StepRecorder(Recording(transitions, env.cost_keys))
    episodes = collect_episodes(
        env,
        policy,
        options.episodes,
        env.cost_keys,
        deterministic=options.deterministic,
        progress=progress,
        record=recorder,
    )
    if recorder is not None:
        recorder.flush()
    return episodes


def _facts(
    directory: Path,
    config: DictConfig,
    checkpoint: Path,
    options: EvaluationOptions,
    node: Mapping[str, Any],
    seed: int,
) -> dict[str, Any]:
    trained = OmegaConf.to_container(config.env)
    assert isinstance(trained, dict)
    shared = shared_layouts(trained, node, same_seed=seed == config.seed)  # type: ignore[arg-type]
    return {
        "run": str(directory),
        "environment": node.get("name", ""),
        "algorithm": config.algo.name,
        "checkpoint_file": str(checkpoint),
        "steps": checkpoint_steps(checkpoint),
        "layouts_trained_on": shared,
        "interval_level": LEVEL,
        **asdict(options),
        "seed": seed,
    }
