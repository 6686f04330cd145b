"""Evaluation of a run's policy: whole episodes, estimates, and their files in the run's folder."""

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

from safe_rl.algorithms.constraints import check_cost_limits
from safe_rl.collectors import Recording, StepRecorder
from safe_rl.evaluation.episodes import Episodes, collect_episodes, default_seed, shared_layouts
from safe_rl.evaluation.loading import load_policy, maker_of, override_env
from safe_rl.evaluation.policies import writable_copy
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.evaluation.video import check_camera, record_episode, video_format, write_video
from safe_rl.files import check_no_links, check_place, replace_csv, replace_json
from safe_rl.runs.checkpoints import hold
from safe_rl.runs.folder import checkpoint_steps
from safe_rl.runs.identity import measure_of
from safe_rl.runs.run import Run
from safe_rl.scores.comparisons import LEVEL, Estimate, cvar, mean, share_over


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation.

    Attributes:
        facts: What was evaluated, and how: JSON-compatible.
        estimates: Name -> estimate, see `safe_rl.evaluation.summarise`.
        files: What was written.
    """

    facts: dict[str, Any]
    estimates: dict[str, Estimate]
    files: tuple[Path, ...]

    def __str__(self) -> str:
        """A table for the terminal."""
        facts, limits = self.facts, self.facts["cost_limits"]
        changed = "".join(f", env.{key}={value}" for key, value in facts["env"].items())
        steps = "" if facts["steps"] is None else f" at {facts['steps']:,} steps"
        known = facts["layouts_trained_on"]
        actions = "its mean actions" if facts["deterministic"] else "sampled actions"
        measure = facts["limited_measure"]
        other = "" if measure == "mean" else f" ({measure}, not mean)"
        width = max(map(len, self.estimates))
        lines = [
            f"{facts['algorithm']} on {facts['environment']}{changed}, checkpoint "
            f"{facts['checkpoint']}{steps}: {facts['episodes']} episodes with {actions}"
            + (f", {known:.0%} of the layouts known from training" if known else ""),
            f"{'':{width}}  estimate [95 % interval]",
        ]
        for name, estimate in self.estimates.items():
            key = name.removeprefix("episode_")
            limit = f"   limit {limits[key]:g}{other}" if key in limits else ""
            lines.append(f"{name:{width}}  {estimate}{limit}")
        lines += [
            f"the run's limit {limit:g} on {key} is not judged: this environment has no such cost"
            for key, limit in facts["limits_without_cost"].items()
        ]
        return "\n".join([*lines, *(f"wrote {path}" for path in self.files)])


@dataclass(frozen=True)
class PolicyEvaluation:
    """A run's policy in an environment, its own or a changed one."""

    config: DictConfig  # of the run; its ``env`` is the environment
    checkpoint: Path
    options: EvaluationOptions
    make_env: Callable[..., EnvBase]  # as in `evaluate`

    @property
    def node(self) -> dict[str, Any]:
        """The environment's configuration."""
        return OmegaConf.to_container(self.config.env)  # type: ignore[return-value]

    @property
    def seed(self) -> int:
        """Seed of layouts and actions."""
        seed = self.options.seed
        return default_seed(self.node, self.config.seed) if seed is None else seed

    def make(self, num_envs: int, seed: int | None = None, **keys: Any) -> EnvBase:
        """Make environments, with some keys changed."""
        return self.make_env(
            {**self.node, **keys}, num_envs=num_envs, device=self.options.device,
            seed=self.seed if seed is None else seed, num_threads=self.options.num_threads,
        )  # fmt: skip

    def policy(self, env: EnvBase) -> TensorDictModuleBase:
        """The policy, for such an environment as `make` returns."""
        return load_policy(self.config, env, self.checkpoint, torch.device(self.options.device))

    def run(
        self, *, progress: bool = False, record: Path | None = None
    ) -> tuple[Episodes, dict[str, Any]]:
        """Run whole episodes; returns them, and the facts: what was evaluated, how, and the limits.

        Limits on costs that the environment lacks are listed apart. All steps are written to the
        folder ``record``, if there is one.
        """
        options = self.options
        limits = {key: float(limit) for key, limit in self.config.cost_limits.items()}
        with closing(self.make(min(options.num_envs, options.episodes))) as env:
            without_cost = {key: limits.pop(key) for key in [*limits] if key not in env.cost_keys}
            limits |= check_cost_limits(options.cost_limits, env.cost_keys)
            policy = self.policy(env)  # before an earlier recording is removed: it may not fit
            recorder = None
            if record is not None:
                known = {"is_privileged": bool(env.privileged_layout)}
                about = {**env.interface, "evaluating": True}
                recorder = StepRecorder(Recording(record, env.cost_keys, about, **known))
            torch.manual_seed(self.seed)
            episodes = collect_episodes(
                env, policy, options.episodes, env.cost_keys, deterministic=options.deterministic,
                progress=progress, record=recorder,
            )  # fmt: skip
            if recorder is not None:
                recorder.flush()
        return episodes, {
            "environment": self.node.get("name", ""),
            "algorithm": self.config.algo.name,
            "checkpoint_file": str(self.checkpoint),
            "steps": checkpoint_steps(self.checkpoint),
            "interval_level": LEVEL,
            **asdict(options),
            "seed": self.seed,
            "cost_limits": limits,
            "limits_without_cost": without_cost,
            "limited_measure": measure_of(self.config),
        }

    def film(self, file: Path, **drawing: Any) -> None:
        """Write an episode as a film or a picture; ``drawing`` are keys of the environment."""
        # world 0 has the same layouts for any number of worlds, but other random actions
        with closing(self.make(1, **drawing)) as single:
            policy = self.policy(single)
            torch.manual_seed(self.seed)
            form = video_format(single, file.suffix[1:])
            frames = record_episode(
                single, policy, deterministic=self.options.deterministic, form=form,
                camera=self.options.camera,
            )  # fmt: skip
            write_video(file, frames, form)


def evaluate(
    directory: Path,
    options: EvaluationOptions,
    *,
    make_env: Callable[..., EnvBase] | None = None,
    progress: bool = False,
) -> Evaluation:
    """Run a trained policy for whole episodes and write estimates into the run's folder.

    Args:
        directory: Folder of a run; a policy of the package is copied into the working directory.
        options: What to evaluate.
        make_env: ``make_env(node, num_envs=, device=, seed=, num_threads=)`` makes environments
            from a run's ``env``; None: those of the run, with its robot and transforms.
        progress: Whether to show a bar.

    Raises:
        FileNotFoundError: If the folder is not a run's, or has no such checkpoint.
        OSError: If results cannot be written, which is checked before any episode.
        CheckpointError: If the checkpoint is damaged, or does not fit the environment.
        ConfigError: If the environment does not accept an override.
        ValueError: If the environment cannot be drawn.
    """
    directory = writable_copy(directory)
    run = Run(directory)
    config = run.config
    checkpoint = hold(run.find_checkpoint(options.checkpoint))
    changed = config.copy()
    changed.env = override_env(config, options.env)
    evaluation = PolicyEvaluation(changed, checkpoint, options, make_env or maker_of(run))
    # some environments draw pictures only if this key asks for it
    drawing: Any = {"render_mode": "rgb_array"} if "render_mode" in evaluation.node else {}
    summary, table = (run.evaluation_file(options.name, kind) for kind in ("json", "csv"))
    films = [run.evaluation_file(options.name, "mp4")] if options.video else []
    films += [Path(options.picture)] if options.picture else []
    kept = [run.evaluation_file(options.name, "transitions")] if options.record else []
    check_no_links(directory)
    for file in (summary, table, *films):
        check_place(file, "A run's evaluations lie in its folder: evaluate a copy of that.")
    for film in films:
        with closing(evaluation.make(1, **drawing)) as single:
            check_camera(single, options.camera, film.suffix[1:])
    episodes, facts = evaluation.run(progress=progress, record=kept[0] if kept else None)
    estimates = summarise(episodes, facts["cost_limits"], options.cvar_alpha)
    known = shared_layouts(
        OmegaConf.to_container(config.env),  # type: ignore[arg-type]
        evaluation.node,
        same_seed=evaluation.seed == config.seed,
    )
    facts = {"run": str(directory), "layouts_trained_on": known, **facts}
    parts = {name: estimate._asdict() for name, estimate in estimates.items()}
    replace_json(summary, {**facts, "estimates": parts})
    columns = {"return": episodes.returns, "length": episodes.lengths, **episodes.costs}
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    replace_csv(table, [columns, *rows])
    for film in films:
        evaluation.film(film, **drawing)
    return Evaluation(facts, estimates, (summary, table, *kept, *films))


def summarise(
    episodes: Episodes, cost_limits: Mapping[str, float], cvar_alpha: float
) -> dict[str, Estimate]:
    """Estimate everything that is reported of an evaluation.

    Args:
        episodes: Returns, lengths and costs of episodes.
        cost_limits: Cost key -> d, undiscounted cost per episode.
        cvar_alpha: Share of the costliest episodes, whose mean cost is the CVaR.

    Returns:
        Estimates by name: ``episode_return``, ``episode_length``, ``episode_<key>`` for every cost
        key; for those with a limit (the first cost where none has) ``cvar_<key>`` and
        ``over_limit_<key>``.

    Examples:
        >>> import torch
        >>> two = torch.tensor([1.0, 3.0])
        >>> episodes = Episodes(two, two, {"cost": torch.tensor([10.0, 30.0])})
        >>> summary = summarise(episodes, {"cost": 25.0}, cvar_alpha=0.5)
        >>> [summary[name].value for name in ("episode_cost", "cvar_cost", "over_limit_cost")]
        [20.0, 30.0, 0.5]
    """
    values = {"return": episodes.returns, "length": episodes.lengths, **episodes.costs}
    estimates = {f"episode_{name}": mean(value) for name, value in values.items()}
    for key in cost_limits or list(episodes.costs)[:1]:
        costs = episodes.costs[key]
        estimates[f"cvar_{key}"] = cvar(costs, cvar_alpha)
        if key in cost_limits:
            estimates[f"over_limit_{key}"] = share_over(costs, cost_limits[key])
    return estimates
