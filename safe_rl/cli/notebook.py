"""The way in from Python: ``safe_rl.train``, ``resume`` and ``load``, for notebooks and scripts.

They do what the commands do, from the same configurations; Hydra stays inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from signal import Signals
from typing import Any

import torch
from omegaconf import DictConfig, open_dict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from safe_rl.cli.certificates import (
    certify_ended,
    certify_run,
    is_to_keep_limits,
    is_worth_a_certificate,
)
from safe_rl.cli.evaluating import evaluate_run
from safe_rl.cli.interrupting import say_if_heard
from safe_rl.cli.options import take_options
from safe_rl.cli.python_settings import compose_new, compose_resumed, new_run, overrides_of
from safe_rl.cli.robots import maker_of
from safe_rl.cli.run_folders import note_missing, remove_new, write_notes
from safe_rl.cli.running import complete, prepare
from safe_rl.cli.user_code import check_imports, import_modules, note_imports, several
from safe_rl.cli.variations import evaluate_varied
from safe_rl.envs import store_configs
from safe_rl.evaluation import Certificate, Evaluation, EvaluationOptions
from safe_rl.evaluation.layouts import default_seed
from safe_rl.evaluation.loading import (
    find_checkpoint,
    for_evaluation,
    load_config,
    load_policy,
    override_env,
)
from safe_rl.evaluation.varying import Varied
from safe_rl.runs.folder import RunFolder, lock_folder
from safe_rl.runs.outcome import final_figures
from safe_rl.runs.table import read_table

__all__ = ["Run", "load", "resume", "train"]


@dataclass(frozen=True)
class Run:
    """A run in its folder: table, environment and trained policy.

    Attributes:
        directory: Its folder.
        checkpoint: Which checkpoint ``policy`` has: "last", "best", "certified", or a path.

    Examples:
        >>> run = getfixture("tiny_run")  # what `safe_rl.train` returns
        >>> sorted(run.final)[:4]
        ['cost_rate', 'episode_cost', 'episode_return', 'steps_per_second']
        >>> run.env.rollout(5, run.policy).shape
        torch.Size([1, 5])
    """

    directory: Path
    checkpoint: str = "last"

    @cached_property
    def config(self) -> DictConfig:
        """Its whole configuration."""
        return load_config(self.directory)

    @cached_property
    def table(self) -> dict[str, list[float]]:
        """Its table by epoch: the columns of ``progress.csv``, as `pandas.DataFrame` takes them.

        Costs of an epoch in which no episode ended are NaN.
        """
        return read_table(RunFolder(self.directory).table)

    @property
    def final(self) -> dict[str, float]:
        """Final J_r (``episode_return``), J_c (``episode_<cost>``) and ρ_c (``<cost>_rate``).

        As :func:`safe_rl.runs.outcome.final_figures` takes them from the table.
        """
        return final_figures(self.table, list(self.config.cost_limits) or ["cost"])

    @cached_property
    def env(self) -> EnvBase:
        """One instance of its environment, with layouts that training has not met."""
        return self.make_env()

    @cached_property
    def policy(self) -> TensorDictModuleBase:
        """Its trained policy; :func:`torchrl.envs.set_exploration_type` chooses mean or sample."""
        path = find_checkpoint(self.directory, self.checkpoint)
        return load_policy(self.config, self.env, path, torch.device("cpu"))

    def make_env(self, num_envs: int = 1, seed: int | None = None, **keys: Any) -> EnvBase:
        """Make its environment.

        Args:
            num_envs: Number of worlds, N.
            seed: Of layouts and noise; None: as for evaluation, one that training never used.
            keys: Keys of the environment to change, such as ``hazards_num=12``.

        Raises:
            ConfigError: If the environment does not accept a key.
        """
        node = override_env(self.config, keys)
        if seed is None:
            seed = default_seed(node, self.config.seed)
        make = for_evaluation(maker_of(self.directory), self.config)
        return make(node, num_envs=num_envs, seed=seed)

    def evaluate(self, **options: Any) -> Evaluation:
        """Run the policy for whole episodes; writes into the folder what the command writes.

        Args:
            options: Those of :class:`safe_rl.evaluation.EvaluationOptions`, such as
                ``episodes=100``; keys of the environment as ``env={"hazards_num": 12}``.

        Raises:
            ValueError: If there is no such option, or it cannot have the value.
        """
        given = {"checkpoint": self.checkpoint, **options}
        return evaluate_run(self.directory, take_options(given, EvaluationOptions))

    def certify(self, **changes: Any) -> Certificate | None:
        """Find and certify its best checkpoint that keeps the limits, as at the end of training.

        Args:
            changes: Keys of the section ``certificate`` to replace, such as ``episodes=2000``.

        Returns:
            The certificate; None if the run has no limits or no checkpoints.

        Raises:
            ValueError: If there is no such key, or it cannot have the value.
        """
        return certify_run(self.directory, changes=changes)

    def vary(self, variations: Any, **options: Any) -> Varied:
        """Run the policy under variations of its environment; writes what the command writes.

        Args:
            variations: As the command's ``variations=``: ``"dynamics"``, or rows of one's own,
                ``{"mass": {"env.mass_scale": [0.5, 2.0]}}``.
            options: Those of :class:`safe_rl.evaluation.EvaluationOptions`.
        """
        given = {"checkpoint": self.checkpoint, "variations": variations, **options}
        return evaluate_varied(self.directory, take_options(given, EvaluationOptions))[0]


def train(
    env: str = "PointGoal1",
    *,
    algo: str = "ppo_lagrangian",
    directory: str | Path | None = None,
    imports: str | Sequence[str] = (),
    config_dir: str | Path | Sequence[str | Path] | None = None,
    **settings: Any,
) -> Run:
    """Train, as ``python train.py env=… algo=…`` does.

    Seeds torch, and sets the number of its threads if ``num_threads`` is given.

    Args:
        env: Name of an environment.
        algo: Name of an algorithm.
        directory: Folder of the run; None: ``runs/<env>/<algo>/<date>_seed<seed>``.
        imports: Module of yours to import before, or several, as the command's ``import=``.
        config_dir: Folder with YAMLs of yours, or several, as the command's ``--config-dir``.
        settings: Any key of ``conf/``: ``frames=100_000``, ``preset="paper"``,
            ``cost_limits={"cost_hazards": 10}``. Keys below another one are dictionaries,
            ``policy_update={"max_kl": 0.02}``, or written with dots, ``**{"env.hazards_num": 12}``.

    Raises:
        ValueError: If a setting is invalid; the message names it.
        FileExistsError: If the folder holds a run.
        KeyboardInterrupt: After Ctrl-C, once the current epoch has its checkpoint, from which
            :func:`resume` continues.

    Examples:
        >>> small = {"num_envs": 2, "frames_per_batch": 40, "env.num_steps": 20, "logger": "none"}
        >>> folder = getfixture("tmp_path") / "first"
        >>> run = train("PointGoal1", algo="cpo", frames=80, directory=folder, **small)
        >>> run.table["steps"]
        [40.0, 80.0]
    """
    modules = import_modules(imports)
    store_configs()
    overrides = new_run(env, algo, settings, config_dir)
    if modules:
        overrides = note_imports(modules, overrides)
    config = compose_new(overrides)
    folder = Path(config.hydra.run.dir if directory is None else directory).expanduser()
    with open_dict(config):
        hydra = config.pop("hydra")
    return _carry_out(config, folder, hydra)


def resume(
    directory: str | Path, *, imports: str | Sequence[str] | None = None, **settings: Any
) -> Run:
    """Continue a run, as ``python train.py resume=…`` does; a finished one stays as it is.

    Args:
        directory: Folder of the run.
        imports: Modules that it needs; as in :func:`load`.
        settings: What to change from now on: ``frames=500_000``,
            ``policy_update={"max_kl": 0.01}``.

    Raises:
        ValueError: If the folder is not that of a run, the run has used modules that ``imports``
            lacks, or a setting cannot change; the message names it.
        KeyboardInterrupt: As by :func:`train`.

    Examples:
        >>> small = {"num_envs": 2, "frames_per_batch": 40, "env.num_steps": 20, "logger": "none"}
        >>> run = train("PointGoal1", directory=getfixture("tmp_path") / "a", frames=40, **small)
        >>> resume(run.directory, frames=80).table["steps"]
        Going on after 40 of 80 frames.
        [40.0, 80.0]
    """
    modules = import_modules(imports or ())
    store_configs()
    overrides = list(overrides_of(settings))
    if imports is not None:
        overrides = note_imports(modules, overrides)
    folder = Path(directory).expanduser()
    return _carry_out(compose_resumed(folder, overrides), folder)


def _carry_out(config: DictConfig, folder: Path, hydra: DictConfig | None = None) -> Run:
    """Train or, without Hydra's own configuration, go on training."""
    complete(config, RunFolder(folder))
    note_missing(folder)
    is_new, has_begun = not folder.exists(), False
    try:
        with lock_folder(RunFolder(folder)):
            trainer = prepare(config, folder, continues=hydra is None)
            has_begun = True
            if trainer is None:
                if RunFolder(folder).certifying.exists():
                    certify_ended(folder, config.num_threads or 0)
                return Run(folder)
            if hydra is not None:
                write_notes(RunFolder(folder), config, hydra)
            trainer.run()
    finally:
        if is_new and not has_begun:
            remove_new(folder)
    if trainer.interrupted_by is not None:
        say_if_heard(
            f"Interrupted. Continue with: python train.py {RunFolder(folder).resuming}, or "
            f"safe_rl.resume({str(folder)!r})"
        )
        if trainer.interrupted_by is Signals.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(128 + trainer.interrupted_by)
    if is_to_keep_limits(config, trainer.algorithm.cost_keys) and is_worth_a_certificate(
        config, trainer.episode_length
    ):
        certify_ended(folder, config.num_threads or 0)
    return Run(folder)


def load(
    directory: str | Path, checkpoint: str = "last", imports: str | Sequence[str] | None = None
) -> Run:
    """Open a run: its table, environment and policy.

    Args:
        directory: Folder of the run.
        checkpoint: "last", "best" (highest return that kept every limit), "certified" (to
            keep them), or a path.
        imports: Modules that its environment or policy needs; none is imported unless named here.
            ``[]`` goes without those that the run has used.

    Raises:
        FileNotFoundError: If the folder is not that of a run, or has no such checkpoint.
        ValueError: If the run has used modules that ``imports`` lacks.

    Examples:
        >>> run = load(getfixture("tiny_run").directory)
        >>> run.policy(run.env.reset())["action"].shape
        torch.Size([1, 2])
    """
    run = Run(Path(directory).expanduser(), checkpoint)
    check_imports(run.config, imports if imports is None else several(imports), run.directory)
    import_modules(imports or ())
    find_checkpoint(run.directory, checkpoint)
    return run
