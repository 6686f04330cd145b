"""The way in from Python: ``safe_rl.train``, ``resume``, ``evaluate`` and ``report``.

They do what the commands do, from the same configurations; Hydra stays inside.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from signal import Signals
from typing import Any

from safe_rl.cli.composing import compose_jobs, compose_resumed, search_folders
from safe_rl.cli.grammar import CommandLineError, overrides_of, take_options
from safe_rl.cli.schema import GIVEN_WHOLE
from safe_rl.cli.session import Session
from safe_rl.cli.trained_run import Run, load
from safe_rl.cli.user_code import import_modules, note_imports
from safe_rl.evaluation import Evaluation
from safe_rl.runs.folder import RunFolder

__all__ = ["Run", "evaluate", "load", "report", "resume", "train"]

Callback = Callable[[Mapping[str, float]], Any]
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

    Seeds torch, and sets the number of its threads if ``num_threads`` is given.

    Args:
        env: Name of an environment.
        algo: Name of an algorithm.
        directory: Folder of the run; None: ``runs/<env>/<algo>/<date>_seed<seed>``.
        imports: Module of yours to import before, or several, as the command's ``import=``.
        callbacks: Called after every epoch with its row of the table; where one returns False, the
            run ends there, like a finished one.
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
    for key, name in {"env": env, "algo": algo}.items():
        if not isinstance(name, str):
            what = " ".join(repr(name).split())[:80]
            raise CommandLineError(f"{key}={what}: it must be a name. {_OF_YOUR_OWN[key]}")
    folders = [config_dir] if isinstance(config_dir, str | Path) else config_dir or ()
    modules = import_modules(imports)
    words = [f"env={env}", f"algo={algo}", *overrides_of(settings, _WHOLE)]
    (config,) = compose_jobs([*search_folders(folders, words), *note_imports(modules or None)])
    folder = None if directory is None else Path(directory).expanduser()
    if folder is not None and RunFolder(folder).has_begun:
        raise FileExistsError(
            f"{folder} already holds a run. Continue it with safe_rl.resume({str(folder)!r}), or "
            "give this one another directory."
        )
    return _carry_out(Session.begin(config, folder, program=None, callbacks=callbacks))


def resume(
    directory: str | Path,
    *,
    imports: str | Sequence[str] | None = None,
    callbacks: Sequence[Callback] = (),
    **settings: Any,
) -> Run:
    """Continue a run, as ``python train.py resume=…`` does; a finished one stays as it is.

    Args:
        directory: Folder of the run.
        imports: Modules that it needs; as in :func:`load`.
        callbacks: As in :func:`train`.
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
        Resuming after 40 of 80 frames.
        [40.0, 80.0]
    """
    modules = None if imports is None else import_modules(imports)
    folder = Path(directory).expanduser()
    config = compose_resumed(folder, overrides_of(settings, _WHOLE), modules)
    return _carry_out(Session(config, folder, continues=True, program=None, callbacks=callbacks))


def _carry_out(session: Session) -> Run:
    session.run()
    if session.interrupted_by is Signals.SIGINT:
        raise KeyboardInterrupt
    if session.interrupted_by is not None:
        raise SystemExit(128 + session.interrupted_by)
    return Run(session.folder.directory)


def evaluate(run: Run | str | Path, **options: Any) -> Evaluation:
    """Run a trained policy for whole episodes, as ``python -m safe_rl.evaluate`` does.

    Args:
        run: The run, or its folder.
        options: As of :meth:`Run.evaluate`.

    Examples:
        >>> print(evaluate(getfixture("tiny_run"), episodes=2))  # doctest: +ELLIPSIS
        ppo_lagrangian on PointGoal1 at 80 steps: 2 episodes with sampled actions, ...
    """
    return (run if isinstance(run, Run) else load(run)).evaluate(**options)


def report(directory: str | Path, **options: Any) -> Path:
    """Report the runs below a folder on one page, as ``python -m safe_rl.report`` does.

    Args:
        directory: The folder.
        options: Those of the command, such as ``title="Mine"``.

    Returns:
        The page.
    """
    from safe_rl.cli.report import ReportOptions
    from safe_rl.cli.report import report as report_runs  # with pandas and Jinja

    return report_runs(Path(directory).expanduser(), take_options(options, ReportOptions))[1]
