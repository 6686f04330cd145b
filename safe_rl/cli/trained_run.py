"""A run in its folder, as Python meets it: figures, pictures, environment and trained policy."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from omegaconf import DictConfig
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from safe_rl.cli.evaluating import certify_run, evaluate_run, evaluate_varied
from safe_rl.cli.grammar import take_options
from safe_rl.cli.run_folders import maker_of
from safe_rl.cli.user_code import check_imports, import_modules
from safe_rl.evaluation import Certificate, Evaluation, EvaluationOptions
from safe_rl.evaluation.episodes import default_seed
from safe_rl.evaluation.loading import (
    find_checkpoint,
    for_evaluation,
    load_config,
    load_policy,
    override_env,
)
from safe_rl.evaluation.policies import find_run
from safe_rl.evaluation.variations import Varied
from safe_rl.extras import import_extra
from safe_rl.files import read_json
from safe_rl.runs.curves import Figure, learning_curves
from safe_rl.runs.display import outcome_line
from safe_rl.runs.folder import RunFolder
from safe_rl.runs.outcome import final_figures
from safe_rl.runs.table import read_table

if TYPE_CHECKING:
    import pandas

__all__ = ["Run", "load"]


@dataclass(frozen=True, repr=False)
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

    @property
    def certificate(self) -> dict[str, Any] | None:
        """The content of ``certificate.json``: bounds, or by how much they are missed; or None."""
        path = RunFolder(self.directory).certificate
        return read_json(path) if path.is_file() else None

    def to_pandas(self) -> pandas.DataFrame:
        """Its table as a frame, a row per epoch; needs the extra ``report``."""
        frame: pandas.DataFrame = import_extra("pandas", "report").DataFrame(self.table)
        return frame

    def plot(self) -> Figure:
        """Its learning curves: return, episode cost, cost rate and multipliers.

        A figure of Matplotlib's, which notebooks show, and ``savefig`` writes.
        """
        config, length = self.config, self.env.max_episode_steps
        title = f"{config.env.name} {config.algo.name} seed {config.seed}"
        return learning_curves(self.table, dict(config.cost_limits), length, title)

    def __repr__(self) -> str:
        """What it is, how it ended, and what is certified."""
        config = self.config
        lines = [f"Run({str(self.directory)!r}): {config.algo.name} on {config.env.name}"]
        if RunFolder(self.directory).num_rows:
            length = int(config.env.get("num_steps") or 1000)
            lines.append(outcome_line(self.table, dict(config.cost_limits), length))
        if self.certificate is not None:
            lines.append(_certified(self.certificate))
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """The same in a notebook, with the learning curves."""
        text = f"<pre>{html.escape(repr(self))}</pre>"
        curves = RunFolder(self.directory).curves
        if not curves.is_file():
            return text
        picture = base64.b64encode(curves.read_bytes()).decode()
        return f'{text}<img alt="learning curves" src="data:image/png;base64,{picture}">'

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
            variations: As the command's ``variations=``: ``"dynamics"``, or custom rows,
                ``{"mass": {"env.mass_scale": [0.5, 2.0]}}``.
            options: Those of :class:`safe_rl.evaluation.EvaluationOptions`.
        """
        given = {"checkpoint": self.checkpoint, "variations": variations, **options}
        return evaluate_varied(self.directory, take_options(given, EvaluationOptions))[0]


def _certified(certificate: dict[str, Any]) -> str:
    """A sentence on the content of ``certificate.json``."""
    level = f"at {certificate['level']:.0%}"
    if not certificate["certified"]:
        return f"Not certified {level}."
    bounds = ", ".join(f"{name} ≤ {b['bound']:.3g}" for name, b in certificate["bounds"].items())
    return f"Certified {level}: {bounds} ({certificate['checkpoint']})."


def load(
    directory: str | Path, checkpoint: str = "last", imports: str | Sequence[str] | None = None
) -> Run:
    """Open a run: its table, environment and policy.

    Args:
        directory: Folder of the run, or ``certified/<environment>`` for one of the package's
            policies, such as ``certified/PointGoal1``.
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
    run = Run(find_run(directory), checkpoint)
    check_imports(run.config, imports, run.directory)
    import_modules(imports or ())
    find_checkpoint(run.directory, checkpoint)
    return run
