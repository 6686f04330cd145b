"""The functions for Python: ``safe_rl.train``, ``resume``, ``load``, ``evaluate``, ``report``.

They do what the commands do, from the same configurations, and leave Hydra's global state as it is.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from signal import SIGINT
from typing import TYPE_CHECKING, Any

import torch
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, open_dict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from safe_rl.cli import report as report_command
from safe_rl.cli.composing import (
    COMPOSING,
    RESUMED,
    compose_run,
    overrides_of,
    read_resumed,
    refuse_changes,
)
from safe_rl.cli.config import check_settings
from safe_rl.cli.options import make_options
from safe_rl.evaluation import Certificate, Evaluation, EvaluationOptions, loading, measuring
from safe_rl.evaluation.certifying import certify_run
from safe_rl.evaluation.episodes import default_seed
from safe_rl.evaluation.policies import find_run
from safe_rl.extras import import_extra
from safe_rl.files import read_bounded
from safe_rl.models import HeldActions
from safe_rl.runs.curves import Figure, learning_curves
from safe_rl.runs.folder import new_folder
from safe_rl.runs.run import KINDS
from safe_rl.runs.run import Run as RecordedRun
from safe_rl.scores.bounds import rounded_up
from safe_rl.training import train as training
from safe_rl.training.train import Callback
from safe_rl.trust import check_imports, import_modules

if TYPE_CHECKING:
    import pandas


def train(
    env: str = "PointGoal1",
    *,
    algo: str = "ppo_lagrangian",
    directory: str | Path | None = None,
    imports: str | Sequence[str] = (),
    callbacks: Sequence[Callback] = (),
    config_dir: str | Path | Sequence[str | Path] | None = None,
    **settings: Any,
) -> Run:
    """Train, as ``python train.py env=… algo=…`` does.

    This seeds torch, and sets the number of its threads if ``num_threads`` is given.

    Args:
        env: Name of an environment.
        algo: Name of an algorithm.
        directory: Folder of the run; None: ``runs/<env>/<algo>/<date>_seed<seed>``.
        imports: A module of yours to import first, or several, as the command's ``import=``.
        callbacks: Called after every epoch with its row of the table. If one returns False, the
            run ends, with its certificate; it can be resumed, and reports call it unfinished.
        config_dir: A folder with YAML files of yours, or several, as the command's
            ``--config-dir``.
        settings: Any key of ``conf/``: ``frames=100_000``, ``preset="gpu"``,
            ``cost_limits={"cost_hazards": 10}``. Keys below another one are dictionaries,
            ``policy_update={"max_kl": 0.02}``, or written with dots, ``**{"env.hazards_num": 12}``.

    Raises:
        ValueError: If a setting is invalid; the message names it.
        FileExistsError: If the folder holds a run.
        KeyboardInterrupt: After Ctrl-C, once the current epoch has its checkpoint, from which
            `resume` continues.

    Examples:
        >>> small = {"num_envs": 2, "frames_per_batch": 40, "env.num_steps": 20, "logger": "none"}
        >>> folder = getfixture("tmp_path") / "first"
        >>> run = train("PointGoal1", algo="cpo", frames=80, directory=folder, **small)
        >>> run.table["steps"]
        [40.0, 80.0]
    """
    if not (isinstance(env, str) and isinstance(algo, str)):
        raise ValueError(
            "env and algo are names. safe_rl.envs.store_config(name, {…}) gives one to an "
            "environment of your own, a YAML file below config_dir=… to an algorithm."
        )
    if "resume" in settings:
        raise ValueError("safe_rl.resume(directory) continues a run.")
    if directory == "":
        raise ValueError("directory=… names the folder of the run.")
    folders = [config_dir] if isinstance(config_dir, str | Path) else config_dir or ()
    modules = [imports] if isinstance(imports, str) else list(imports)
    import_modules(modules)
    more = {"import": modules} if modules else {}
    config = compose_run([f"env={env}", f"algo={algo}", *overrides_of(settings | more)], folders)
    check_settings(config)
    folder = new_folder(Path(config.hydra.run.dir)) if directory is None else directory
    return _carry_out(config, Path(folder).expanduser(), callbacks)


def resume(
    directory: str | Path,
    *,
    imports: str | Sequence[str] | None = None,
    callbacks: Sequence[Callback] = (),
    **settings: Any,
) -> Run:
    """Continue a run, or certify a finished one, as ``python train.py resume=…`` does.

    Args:
        directory: Folder of the run.
        imports: Modules that the run needs, as in `load`.
        callbacks: As in `train`.
        settings: Keys to change from now on, such as ``frames=500_000`` or
            ``policy_update={"max_kl": 0.01}``.

    Raises:
        ValueError: If the folder holds no run, the run has used modules and ``imports`` is None,
            or a setting cannot change; the message names it.
        KeyboardInterrupt: As in `train`.

    Examples:
        >>> small = {"num_envs": 2, "frames_per_batch": 40, "env.num_steps": 20, "logger": "none"}
        >>> run = train("PointGoal1", directory=getfixture("tmp_path") / "a", frames=40, **small)
        >>> resume(run.directory, frames=80).table["steps"]
        Resuming after 40 of 80 frames.
        [40.0, 80.0]
    """
    folder = Path(directory).expanduser()
    modules = [imports] if isinstance(imports, str) else imports
    import_modules(modules)
    words = list(overrides_of(settings))
    with COMPOSING:
        ConfigStore.instance().store(RESUMED, read_resumed(folder.absolute(), modules, words))
        config = compose_run(words, name=RESUMED)
    refuse_changes(folder.absolute(), config)
    check_settings(config)
    return _carry_out(config, folder, callbacks, continues=True)


def _carry_out(
    config: DictConfig, folder: Path, callbacks: Sequence[Callback], *, continues: bool = False
) -> Run:
    with open_dict(config):
        hydra = config.pop("hydra")
    notes = None if continues else hydra
    try:
        training.train(
            config, folder, hydra=notes, continues=continues, callbacks=callbacks, program=None
        )
    except SystemExit as end:
        if end.code == 128 + SIGINT:
            raise KeyboardInterrupt from None
        raise
    return Run(folder)


def evaluate(run: Run | str | Path, **options: Any) -> Evaluation:
    """Run a trained policy for whole episodes, as ``safe-rl evaluate`` does.

    Args:
        run: The run, or its folder.
        options: Those of `Run.evaluate`.

    Examples:
        >>> print(evaluate(getfixture("tiny_run"), episodes=2))  # doctest: +ELLIPSIS
        ppo_lagrangian on PointGoal1, checkpoint last at 80 steps: 2 episodes with ...
    """
    return (run if isinstance(run, Run) else load(run)).evaluate(**options)


def load(
    directory: str | Path, checkpoint: str = "last", imports: str | Sequence[str] | None = None
) -> Run:
    """Open a run: its table, environment and policy.

    Args:
        directory: Folder of the run, or ``certified/<environment>`` for one of the package's
            policies, such as ``certified/PointGoal1``.
        checkpoint: "last", "best" (the highest return among those that kept every limit),
            "certified" (to keep the limits), or a path.
        imports: Modules that the environment or policy needs; no others are imported. ``[]`` opens
            the run without the modules that it has used.

    Raises:
        FileNotFoundError: If the folder holds no run, or the run has no such checkpoint.
        ValueError: If the run has used modules and ``imports`` is None.

    Examples:
        >>> run = load(getfixture("tiny_run").directory)
        >>> run.policy(run.env.reset())["action"].shape
        torch.Size([1, 2])
    """
    run = Run(find_run(directory), checkpoint)
    check_imports(run.config, imports, run.directory)
    import_modules(imports)
    run.find_checkpoint(checkpoint)
    return run


def report(directory: str | Path, **options: Any) -> Path:
    """Report the runs below a folder on one page, as ``safe-rl report`` does.

    Args:
        directory: The folder.
        options: Those of the command, such as ``title="Mine"``.

    Returns:
        Path of the page.
    """
    given = make_options(options, report_command.ReportOptions)
    return report_command.report(Path(directory).expanduser(), given)[1]


class Run(RecordedRun):
    """A run in its folder: table, environment and trained policy.

    Args:
        directory: Its folder.
        checkpoint: The checkpoint of ``policy``: "last", "best", "certified", or a path.

    Attributes:
        directory: Its folder.
        checkpoint: The checkpoint of ``policy``.

    Examples:
        >>> run = getfixture("tiny_run")  # what `safe_rl.train` returns
        >>> sorted(run.final)[:4]
        ['cost_rate', 'episode_cost', 'episode_return', 'steps_per_second']
        >>> run.env.rollout(5, run.policy).shape
        torch.Size([1, 5])
    """

    def __init__(self, directory: Path | str, checkpoint: str = "last") -> None:
        # they are read later, perhaps from another working directory
        super().__init__(Path(directory).absolute())
        is_file = checkpoint not in KINDS and Path(checkpoint).exists()
        self.checkpoint = str(Path(checkpoint).absolute()) if is_file else checkpoint

    @cached_property
    def env(self) -> EnvBase:
        """One instance of its environment, with layouts that training has not used."""
        return self.make_env()

    @cached_property
    def policy(self) -> TensorDictModuleBase:
        """Its trained policy; `torchrl.envs.set_exploration_type` selects mean or sample.

        After training with ``transforms=[action_repeat]`` it is a `HeldActions`, which also acts
        step by step in an environment without this transform.
        """
        path = self.find_checkpoint(self.checkpoint)
        policy = loading.load_policy(self.config, self.env, path, torch.device("cpu"))
        steps = self.env.steps_per_decision
        return policy if steps == 1 else HeldActions(policy, steps)

    def to_pandas(self) -> pandas.DataFrame:
        """Its table as a data frame with a row per epoch; needs the extra ``report``."""
        return import_extra("pandas", "report").DataFrame(self.table)

    def plot(self) -> Figure:
        """Its learning curves, a Matplotlib figure: return, costs, cost rates and multipliers."""
        length = self.episode_length or self.env.max_episode_steps
        title = f"{self.environment} {self.algorithm} seed {self.seed}"
        return learning_curves(self.table, self.cost_limits, length, title, self.measure)

    def __repr__(self) -> str:
        """Algorithm, environment, outcome and certificate."""
        lines = [f"Run({str(self.directory)!r}): {self.algorithm} on {self.environment}"]
        if self.num_rows:
            lines.append(self.outcome)
        if (certificate := self.certificate) is not None:
            shown = certificate["bounds"] if certificate["certified"] else {}
            bounds = [f"{name} ≤ {rounded_up(b['bound']):.3g}" for name, b in shown.items()]
            which = f": {', '.join(bounds)} ({certificate['checkpoint']})" if bounds else ""
            level = f"{100 * certificate['level']:.12g}%"  # not rounded up to 100
            lines.append(f"{'C' if which else 'Not c'}ertified at {level}{which}.")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """The same for a notebook, with the learning curves."""
        text = f"<pre>{html.escape(repr(self))}</pre>"
        curves = self.curves_file
        is_drawn = curves.is_file() and not curves.is_symlink()  # a link may lead to any file
        picture = base64.b64encode(read_bounded(curves, 10**8)).decode() if is_drawn else ""
        shown = f'<img alt="learning curves" src="data:image/png;base64,{picture}">'
        return text + (shown if picture else "")

    def make_env(self, num_envs: int = 1, seed: int | None = None, **keys: Any) -> EnvBase:
        """Make its environment.

        Args:
            num_envs: Number of environment instances, N.
            seed: Seed of layouts and noise; None: that of evaluations, which training never uses.
            keys: Keys of the environment to change, such as ``hazards_num=12``.

        Raises:
            ConfigError: If the environment does not accept a key.
        """
        node = loading.override_env(self.config, keys)
        seed = default_seed(node, self.config.seed) if seed is None else seed
        return loading.maker_of(self)(node, num_envs=num_envs, seed=seed)

    def evaluate(self, **options: Any) -> Evaluation:
        """Run the policy for whole episodes; write the command's files into the folder.

        Args:
            options: Those of `safe_rl.evaluation.EvaluationOptions`, such as
                ``episodes=100``; keys of the environment as ``env={"hazards_num": 12}``.

        Raises:
            ValueError: If there is no such option, or it cannot have the value.
        """
        given = {"checkpoint": self.checkpoint, **options}
        return measuring.evaluate(self.directory, make_options(given, EvaluationOptions))

    def certify(self, **changes: Any) -> Certificate | None:
        """Certify the best checkpoint that keeps the limits, as at the end of training.

        Args:
            changes: Keys of the section ``certificate`` to change, such as ``episodes=2000``; and
                ``deterministic=True`` to certify the policy with its mean actions.

        Returns:
            The certificate; None if the run has no limits or no checkpoints.

        Raises:
            ValueError: If there is no such key, or it cannot have the value.
        """
        return certify_run(self.directory, changes=changes)
