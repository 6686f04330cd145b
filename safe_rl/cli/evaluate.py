"""Evaluate a trained policy: ``python -m safe_rl.evaluate RUN_DIR [episodes=100 video=true]``."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import safe_rl.openmp  # noqa: F401, has to come before torch

# isort: split
import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import CheckpointError

from safe_rl.cli.options import OptionError, parse_options, usage
from safe_rl.envs import ConfigError, OpenGLError, SafetyGymEnv, make_env
from safe_rl.envs.safety_gym.suite import SUITE
from safe_rl.evaluation.episodes import collect_episodes
from safe_rl.evaluation.layouts import default_seed, shared_layouts
from safe_rl.evaluation.loading import (
    checkpoint_steps,
    find_checkpoint,
    load_config,
    load_policy,
    override_env,
)
from safe_rl.evaluation.settings import EvaluationOptions, check_options
from safe_rl.evaluation.summary import format_estimates, summarise, write_episodes, write_summary
from safe_rl.evaluation.video import record_episode, write_video
from safe_rl.scores.intervals import LEVEL, Estimate
from safe_rl.scores.published import REFERENCE, Scores

__all__ = ["Evaluation", "evaluate", "main"]

COMMAND = "python -m safe_rl.evaluate"


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found.

    Attributes:
        facts: What was evaluated, and how: JSON-compatible.
        estimates: Name -> estimate, see :func:`safe_rl.evaluation.summary.summarise`.
        files: What was written.
    """

    facts: dict[str, Any]
    estimates: dict[str, Estimate]
    files: tuple[Path, ...]


def evaluate(directory: Path, options: EvaluationOptions, *, progress: bool = False) -> Evaluation:
    """Run a trained policy for whole episodes and write what they say into the run's folder.

    Args:
        directory: Folder of a run.
        options: What to evaluate.
        progress: Whether to show a bar.

    Raises:
        FileNotFoundError: If the folder is not a run's, or has no such checkpoint.
        CheckpointError: If the checkpoint is damaged, or does not fit the environment.
        ConfigError: If the environment does not accept an override.
        ValueError: If an option is out of its range.
    """
    check_options(options)
    config = load_config(directory)
    checkpoint = find_checkpoint(directory, options.checkpoint)
    node = override_env(config, options.env)
    seed = default_seed(node, config.seed) if options.seed is None else options.seed
    env = _make_env(node, options, seed, min(options.num_envs, options.episodes))
    policy = load_policy(config, env, checkpoint, torch.device(options.device))
    torch.manual_seed(seed)
    episodes = collect_episodes(
        env,
        policy,
        options.episodes,
        env.cost_keys,
        deterministic=options.deterministic,
        progress=progress,
    )
    limits = {key: float(d) for key, d in config.cost_limits.items() if key in env.cost_keys}
    estimates = summarise(episodes, limits, _reference(node, env), options.cvar_alpha)
    facts = _facts(directory, config, checkpoint, options, node, seed) | {"cost_limits": limits}
    stem = directory / "_".join(filter(None, ("evaluation", options.name)))
    files = [stem.with_name(f"{stem.name}.{suffix}") for suffix in ("json", "csv", "mp4")]
    write_summary(files[0], facts, estimates)
    write_episodes(files[1], episodes)
    if options.video:
        torch.manual_seed(seed)
        # the first world draws the same episodes whatever the number of worlds
        single = _make_env(node, options, seed, num_envs=1)
        frames = record_episode(
            single, policy, deterministic=options.deterministic, camera=options.camera
        )
        write_video(files[2], frames)
    return Evaluation(facts, estimates, tuple(files if options.video else files[:2]))


def _make_env(
    node: Mapping[str, Any], options: EvaluationOptions, seed: int, num_envs: int
) -> SafetyGymEnv:
    return make_env(
        node, num_envs=num_envs, device=options.device, seed=seed, num_threads=options.num_threads
    )


def _reference(node: Mapping[str, Any], env: SafetyGymEnv) -> Scores | None:
    """Scores to normalise by: those of the suite's environment, if this is exactly it."""
    name = node.get("name", "")
    layouts = {"layout_seeds": None, "layout_seeds_first": 0}
    return REFERENCE.get(name) if env.config.replace(**layouts) == SUITE.get(name) else None


def _facts(
    directory: Path,
    config: DictConfig,
    checkpoint: Path,
    options: EvaluationOptions,
    node: Mapping[str, Any],
    seed: int,
) -> dict[str, Any]:
    trained = OmegaConf.to_container(config.env, resolve=True)
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


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage(f"{COMMAND} RUN_DIR", EvaluationOptions))
        return 0 if arguments else 2
    try:
        options = parse_options(arguments[1:], EvaluationOptions)
        result = evaluate(Path(arguments[0]), options, progress=True)
    except (
        *(OptionError, ConfigError, CheckpointError, OpenGLError),
        *(FileNotFoundError, ModuleNotFoundError, ValueError),
    ) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(_report(result))
    return 0


def _report(result: Evaluation) -> str:
    facts = result.facts
    steps = "" if facts["steps"] is None else f" at {facts['steps']:,} steps"
    manner = "its mean actions" if facts["deterministic"] else "sampled actions"
    lines = [
        f"{facts['algorithm']} on {facts['environment']}{steps}: {facts['episodes']} episodes with "
        f"{manner}, {facts['layouts_trained_on']:.0%} of the layouts known from training",
        *format_estimates(result.estimates, facts["cost_limits"]),
        *(f"wrote {path}" for path in result.files),
    ]
    return "\n".join(lines)
