"""A trained policy measured: from a run's folder to estimates, and their files in it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
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
from safe_rl.evaluation.video import check_camera, record_episode, video_format, write_video
from safe_rl.files import check_no_links, check_place, replace_csv, replace_text
from safe_rl.runs.folder import RunFolder, checkpoint_steps
from safe_rl.scores.benchmark import Scores, Suite
from safe_rl.scores.comparisons import LEVEL, Estimate, cvar, mean, share_over
from safe_rl.scores.measures import normalised_return, normalised_violation

__all__ = [
    *("Evaluation", "check_places", "evaluate", "format_estimates", "format_unjudged", "summarise"),
]

# which layouts are shown does not make it another environment
_LAYOUTS = ("layout_seeds", "layout_seeds_first")


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        facts: What was evaluated, and how: JSON-compatible.
        estimates: Name -> estimate, see :func:`safe_rl.evaluation.summarise`.
        files: What was written.
    """

    facts: dict[str, Any]
    estimates: dict[str, Estimate]
    files: tuple[Path, ...]

    def __str__(self) -> str:
        """A table for the terminal."""
        facts = self.facts
        steps = "" if facts["steps"] is None else f" at {facts['steps']:,} steps"
        actions = "its mean actions" if facts["deterministic"] else "sampled actions"
        lines = [
            f"{facts['algorithm']} on {facts['environment']}{steps}: {facts['episodes']} episodes "
            f"with {actions}, {facts['layouts_trained_on']:.0%} of the layouts known from training",
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
    seed, make = env_maker(config, node, options, make_env)
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
        steps = (
            StepRecorder(Recording(places["transitions"], cost_keys)) if options.record else None
        )
        policy, episodes = run_policy(config, checkpoint, env, options, seed, progress, steps)
        if steps is not None:
            steps.flush()
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
            form = video_format(single, film.suffix[1:])
            frames = record_episode(
                single, policy, cost_keys, deterministic=options.deterministic, form=form,
                camera=options.camera,
            )  # fmt: skip
            write_video(film, frames, form)
    kept = [places["transitions"]] if options.record else []
    return Evaluation(facts, estimates, (places["json"], places["csv"], *kept, *films))


def env_maker(
    config: DictConfig,
    node: Mapping[str, Any],
    options: EvaluationOptions,
    make_env: Callable[..., EnvBase],
) -> tuple[int, Callable[..., EnvBase]]:
    """Seed of an evaluation, and what makes environments: ``make(num_envs, **changed_keys)``."""
    seed = default_seed(node, config.seed) if options.seed is None else options.seed
    threads = options.num_threads

    def make(num_envs: int, **keys: Any) -> EnvBase:
        return for_evaluation(make_env, config)(
            {**node, **keys}, num_envs=num_envs, device=options.device, seed=seed,
            num_threads=threads,
        )  # fmt: skip

    return seed, make


def run_policy(
    config: DictConfig,
    checkpoint: Path,
    env: EnvBase,
    options: EvaluationOptions,
    seed: int,
    progress: bool = False,
    recorder: StepRecorder | None = None,
) -> tuple[TensorDictModuleBase, Episodes]:
    """The policy of a checkpoint, and whole episodes of it; a recorder gets all steps."""
    policy = load_policy(config, env, checkpoint, torch.device(options.device))
    torch.manual_seed(seed)
    return policy, collect_episodes(
        env, policy, options.episodes, env.cost_keys, deterministic=options.deterministic,
        progress=progress, record=recorder,
    )  # fmt: skip


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


def check_places(places: Iterable[Path]) -> None:
    """Refuse files in a run's folder that cannot be written, before any episode."""
    places = list(places)
    for folder in {place.parent for place in places}:
        check_no_links(folder)
    for place in places:
        check_place(place, "A run's evaluations lie in its folder: evaluate a copy of that.")


def summarise(
    episodes: Episodes,
    cost_limits: Mapping[str, float],
    reference: Scores | None,
    cvar_alpha: float,
) -> dict[str, Estimate]:
    """Estimate everything that is reported of an evaluation.

    Args:
        episodes: What happened.
        cost_limits: Cost key -> d, undiscounted cost per episode.
        reference: Characteristic metrics of the environment, for normalised scores; or None.
        cvar_alpha: Share of the costliest episodes that the CVaR is the mean of.

    Returns:
        Estimates by name: ``episode_return``, ``episode_length``, ``episode_<key>`` for every cost
        key; for those with a limit (the first cost where none has) ``cvar_<key>`` and
        ``over_limit_<key>``; ``normalised_return`` and ``normalised_violation``.

    Examples:
        >>> import torch
        >>> two = torch.tensor([1.0, 3.0])
        >>> episodes = Episodes(two, two, {"cost": torch.tensor([10.0, 30.0])})
        >>> summary = summarise(episodes, {"cost": 25.0}, None, cvar_alpha=0.5)
        >>> [summary[name].value for name in ("episode_cost", "cvar_cost", "over_limit_cost")]
        [20.0, 30.0, 0.5]
    """
    estimates = {
        "episode_return": mean(episodes.returns),
        "episode_length": mean(episodes.lengths),
    }
    estimates |= {f"episode_{key}": mean(costs) for key, costs in episodes.costs.items()}
    for key in cost_limits or list(episodes.costs)[:1]:
        estimates[f"cvar_{key}"] = cvar(episodes.costs[key], cvar_alpha)
        if key in cost_limits:
            over = share_over(episodes.costs[key], cost_limits[key])
            estimates[f"over_limit_{key}"] = over
    if reference is not None:
        estimates["normalised_return"] = Estimate(
            *map(float, normalised_return(estimates["episode_return"], reference))
        )
    if reference is not None and "cost" in cost_limits:
        # monotone in J_c, so the interval's ends are those of J_c
        violation = normalised_violation(estimates["episode_cost"], cost_limits["cost"], reference)
        estimates["normalised_violation"] = Estimate(*map(float, violation))
    return estimates


def format_estimates(
    estimates: Mapping[str, Estimate], cost_limits: Mapping[str, float]
) -> list[str]:
    """Lines of a table for the terminal."""
    width = max(map(len, estimates))
    lines = [f"{'':{width}} {'estimate':>10}   95 % interval"]
    for name, estimate in estimates.items():
        key = name.removeprefix("episode_")
        limit = f"   limit {cost_limits[key]:g}" if key in cost_limits else ""
        interval = f"[{_number(estimate.low)}, {_number(estimate.high)}]"
        lines.append(f"{name:{width}} {_number(estimate.value):>10}   {interval}{limit}")
    return lines


def format_unjudged(limits: Mapping[str, float]) -> list[str]:
    """A line for each limit of the run on a cost that its changed environment does not have.

    Examples:
        >>> format_unjudged({"cost_hazards": 20.0})
        ["the run's limit 20 on cost_hazards is not judged: this environment has no such cost"]
    """
    return [
        f"the run's limit {limit:g} on {key} is not judged: this environment has no such cost"
        for key, limit in limits.items()
    ]


def _number(value: float) -> str:
    return "—" if math.isnan(value) else f"{value:.4g}"


def write_summary(path: Path, facts: Mapping[str, Any], estimates: Mapping[str, Estimate]) -> None:
    """Write facts and estimates as JSON, in one go; what is not a number becomes null."""
    content = {
        **facts,
        "estimates": {
            name: {
                part: value if math.isfinite(value) else None
                for part, value in estimate._asdict().items()
            }
            for name, estimate in estimates.items()
        },
    }
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    replace_text(path, text)


def write_episodes(path: Path, episodes: Episodes) -> None:
    """Write one row per episode as CSV, in one go."""
    columns = {"return": episodes.returns, "length": episodes.lengths, **episodes.costs}
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    replace_csv(path, [columns, *rows])
