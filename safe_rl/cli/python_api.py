"""The way in from Python: ``safe_rl.train``, ``resume`` and ``load``, for notebooks and scripts.

They do what the commands do, from the same configurations; Hydra stays inside.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from signal import Signals
from typing import Any

import torch
from omegaconf import DictConfig, open_dict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from safe_rl.cli.certificates import certify_run
from safe_rl.cli.composing import GIVEN_WHOLE, compose_jobs, resolving
from safe_rl.cli.evaluating import evaluate_run, evaluate_varied
from safe_rl.cli.grammar import CommandLineError, overrides_of, take_options
from safe_rl.cli.resuming import compose_resumed
from safe_rl.cli.robots import maker_of
from safe_rl.cli.session import Session, missing_folders, new_folder
from safe_rl.cli.user_code import check_imports, import_modules, note_imports, several
from safe_rl.evaluation import Certificate, Evaluation, EvaluationOptions
from safe_rl.evaluation.episodes import default_seed
from safe_rl.evaluation.loading import (
    find_checkpoint,
    for_evaluation,
    load_config,
    load_policy,
    override_env,
)
from safe_rl.evaluation.varying import Varied
from safe_rl.runs.folder import RunFolder
from safe_rl.runs.outcome import final_figures
from safe_rl.runs.table import read_table

__all__ = ["Run", "load", "resume", "train"]

# mappings that are given all at once
_WHOLE = (
    *GIVEN_WHOLE,
    *("env.outside", "env.kwargs", "env.cost", "memory.prioritised", "policy_update.rates"),
)
_OF_YOUR_OWN = {
    "env": "safe_rl.envs.store_config(name, {…}) gives one to keys, and what Gymnasium has "
    "registered is 'gymnasium' with **{'env.id': …}.",
    "algo": "One of your own is a YAML, which config_dir=… finds.",
}


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
    _check_kinds(imports, directory)
    modules = import_modules(imports)
    overrides = [*_new_run(env, algo, settings, config_dir), *note_imports(modules or None)]
    (config,) = compose_jobs(overrides)
    if directory is None:
        with resolving(config):
            folder, missing = new_folder(config.hydra)
    else:
        folder = Path(directory).expanduser()
        missing = missing_folders(folder)
    with open_dict(config):
        own = config.pop("hydra")
    return _carry_out(
        Session(config, folder, own, missing=missing, otherwise=_otherwise(folder), quiet=True)
    )


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
    _check_kinds(imports, directory)
    modules = None if imports is None else import_modules(imports)
    folder = Path(directory).expanduser()
    config = compose_resumed(folder, overrides_of(settings, _WHOLE), modules)
    return _carry_out(
        Session(config, folder, continues=True, otherwise=_otherwise(folder), quiet=True)
    )


def _check_kinds(imports: Any, directory: Any) -> None:
    """Refuse what names neither modules nor a folder.

    Raises:
        CommandLineError: If so.
    """
    names = [imports] if isinstance(imports, str | None) else imports
    if not isinstance(names, Sequence) or not all(isinstance(n, str | None) for n in names):
        raise CommandLineError(f"imports={imports!r}: it must be names of modules.")
    if not isinstance(directory, str | os.PathLike | None):
        raise CommandLineError(f"directory={directory!r}: it must be the path of a folder.")


def _carry_out(session: Session) -> Run:
    session.run()
    if session.interrupted_by is Signals.SIGINT:
        raise KeyboardInterrupt
    if session.interrupted_by is not None:
        raise SystemExit(128 + session.interrupted_by)
    return Run(session.folder.directory)


def _otherwise(folder: Path) -> str:
    """What continues a run beside the command."""
    return f", or safe_rl.resume({str(folder)!r})"


def _new_run(
    env: Any,
    algo: Any,
    settings: Mapping[str, Any],
    folders: str | Path | Sequence[str | Path] | None,
) -> list[str]:
    """Overrides of a new run: environment and algorithm by their names, settings, YAMLs' folders.

    Raises:
        CommandLineError: If one is no name, a setting nothing that can be written, a folder not
            there.
    """
    for key, value in {"env": env, "algo": algo}.items():
        if not isinstance(value, str):
            what = " ".join(repr(value).split())[:80]
            raise CommandLineError(f"{key}={what}: it must be a name. {_OF_YOUR_OWN[key]}")
    given = [folders] if isinstance(folders, str | Path) else folders or ()
    found = [Path(folder).expanduser().absolute() for folder in given]
    if missing := next((folder for folder in found if not folder.is_dir()), None):
        raise CommandLineError(f"config_dir={missing}: there is no such folder.")
    if found:
        settings = {**settings, "hydra.searchpath": [f"file://{folder}" for folder in found]}
    return [f"env={env}", f"algo={algo}", *overrides_of(settings, _WHOLE)]


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
