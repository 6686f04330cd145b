"""Train a run in its folder, continue it, and certify it at its end."""

from __future__ import annotations

import logging
import math
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from shlex import quote
from signal import SIGINT, Signals
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import CheckpointError

from safe_rl import trust
from safe_rl.checks import SettingError
from safe_rl.collectors import EpisodeError, WorkerError
from safe_rl.envs import ConfigError, ContractError, complete_env, make_env
from safe_rl.evaluation import Certificate, certify
from safe_rl.evaluation.episodes import default_seed, has_fixed_layout, periodic_evaluation
from safe_rl.evaluation.loading import keep_robot, robot_of, transforms_of
from safe_rl.evaluation.settings import certificate_options
from safe_rl.files import PROGRAM, replacing
from safe_rl.runs.checkpoints import is_finished
from safe_rl.runs.folder import RunInUseError, checkpoint_steps, lock_folder
from safe_rl.runs.identity import check_same_run
from safe_rl.runs.outcome import violation
from safe_rl.runs.run import Run
from safe_rl.runs.table import TableError
from safe_rl.training.building import begin_from, build_trainer, physics_threads, seed_everything
from safe_rl.training.trainer import Trainer

Callback = Callable[[Mapping[str, float]], Any]
"""Called after every epoch with its row of the table; one that returns False ends the run."""

SETTING_ERRORS: tuple[type[Exception], ...] = (
    *(ValueError, CheckpointError, OmegaConfBaseException, OSError, ModuleNotFoundError),
)
_WHILE_TRAINING = (
    *(OSError, TableError, ConfigError, ContractError, EpisodeError, FloatingPointError),
    *(SettingError, WorkerError, MemoryError),
)
_UNEXPECTED = "This happened during training, not because of a setting."


def is_expected(error: Exception) -> bool:
    """Whether an error is about settings, files or the environment: the message is enough."""
    is_known = isinstance(error, SETTING_ERRORS + _WHILE_TRAINING)
    return is_known and _UNEXPECTED not in getattr(error, "__notes__", ())


@torch.enable_grad()  # a notebook may have turned gradients off
def train(
    config: DictConfig,
    directory: Path | str,
    *,
    continues: bool = False,
    callbacks: Sequence[Callback] = (),
    program: str | None = PROGRAM,
) -> Run:
    """Train, or continue to train; at the end, certify a run that is to keep limits.

    Ctrl-C, SIGTERM or a closed terminal ends the run after the current epoch.

    Args:
        config: The configuration, checked. Hydra's settings in its node ``hydra``, if any, are
            written into the notes of a new run.
        directory: Folder of the run.
        continues: Whether to continue the run in the folder, or to begin it if there is none.
        callbacks: Called after every epoch with its row of the table; one that returns False ends
            the run.
        program: The command, as the user has called it; None: Python, where the outcome is not
            printed.

    Returns:
        The run.

    Raises:
        SystemExit: If a signal has ended the run; the status is 128 and the signal's number.
        FileExistsError: If the folder of a new run holds one.
        Exception: Of any type; `is_expected` tells whether the message is enough for the user.
    """
    # Python shows the outcome of the run that is returned
    run, say = Run(directory), _print if program else lambda line: None
    hydra = _complete(config, run)
    again = _command_again(run, config, program)
    with _named_memory(config), _removed_unless_begun(run), lock_folder(run.lock_file):
        if continues and is_finished(run.checkpoints("last"), config.frames):
            done = f"{run.directory} has its {config.frames:,} frames already"
            print(f"{done}: raise 'frames' to train on.")
            is_constrained = config.algo.get("constrained") is not False
            with closing(make_env(robot_of(run, _plain(config.env)), num_envs=1)) as env:
                stopped, length = None, env.max_episode_steps
        else:
            if not continues:
                _check_is_free(run, again, "hydra.run.dir" if program else "directory")
            trainer = _prepare(config, run, continues, callbacks, say)
            if config.frames < (first := config.num_envs * trainer.episode_length):
                say(
                    f"No episode will end: {config.num_envs} environments with episodes of "
                    f"{trainer.episode_length:,} steps end the first ones after {first:,} frames. "
                    "Set frames=… or num_envs=…"
                )
            if hydra is not None and not (continues and run.notes_folder.exists()):
                _write_notes(run, config, hydra)
            with _during_training():
                say(trainer.run())
            stopped, length = trainer.stopped_by, trainer.episode_length
            is_constrained = bool(trainer.algorithm.cost_keys)
            if not trainer.is_finished:
                _end(stopped, f"Interrupted. Continue with: {again}")
        if _is_to_be_certified(run, config, length, is_constrained, say):
            _end(stopped, f"Interrupted before it was certified. To do so: {again}")
            _certify(run, config, again, say)
    return run


def run_job(config: DictConfig, directory: Path | str) -> float:
    """Begin or continue the run of one job of a sweep; a finished run is skipped.

    Returns:
        The value that an optimising sweeper maximises: the run's final return, or −∞ if it ends
        above a limit or no episode has ended.

    Raises:
        SystemExit: If it is interrupted.
        ValueError: If its folder holds a run with other settings.
    """
    run = Run(directory)
    if run.is_run:
        hydra = _complete(config, run)
        check_same_run(run, config)
        with open_dict(config):
            config.hydra = hydra
    train(config, run.directory, continues=True)
    figures, limits = run.final, run.cost_limits
    value = figures["episode_return"]
    is_above = any(violation(figures, key, limit) > 0 for key, limit in limits.items())
    return -math.inf if is_above or math.isnan(value) else value


def certify_run(
    directory: Path | str,
    *,
    num_threads: int = 0,
    changes: Mapping[str, Any] | None = None,
    deterministic: bool = False,
) -> Certificate | None:
    """Certify the best checkpoint of a run that keeps its limits; no other process may write it.

    Args:
        directory: Folder of the run.
        num_threads: Threads that step environments; 0 is one per core.
        changes: Keys of the section ``certificate`` to change.
        deterministic: Whether the policy acts with its mean actions.

    Returns:
        The certificate; None if the run has no limits or no checkpoints.

    Raises:
        RunInUseError: If another process writes into the folder.
        ValueError: If there is no such key, or it cannot have the value.
    """
    run = Run(directory)
    asked = {**(changes or {}), **({"deterministic": True} if deterministic else {})}
    options = certificate_options(run.config, asked)
    with lock_folder(run.lock_file):  # an unwritable folder is found before hours of tests
        return certify(run.directory, options, num_threads=num_threads, progress=True)


def _complete(config: DictConfig, run: Run) -> DictConfig | None:
    """Add the environment's defaults to its node, for the saved configuration; take ``hydra``."""
    given = _plain(config.env)
    # keys that are null take the value that is found
    known = {key: value for key, value in given.items() if value is not None}
    with open_dict(config):
        config.env = complete_env(robot_of(run, given)) | known
        return config.pop("hydra", None)


def _plain(node: DictConfig) -> dict[str, Any]:
    return OmegaConf.to_container(node, resolve=True)  # type: ignore[return-value]


def _command_again(run: Run, config: DictConfig, program: str | None) -> str:
    """The command that continues a run."""
    modules = list(config.get("import") or [])
    if program is None:
        return f"safe_rl.resume({str(run.directory)!r}{f', imports={modules}' if modules else ''})"
    return f"{program}{_imports(config)} resume={quote(str(run.directory))}"


def _imports(config: DictConfig) -> str:
    return "".join(f" import={quote(name)}" for name in config.get("import") or [])


@contextmanager
def _removed_unless_begun(run: Run) -> Iterator[None]:
    """Remove a new folder, or one that Hydra has made, if the run in it cannot begin."""
    is_new = not run.directory.exists() or not any(run.directory.iterdir())
    try:
        yield
    except RunInUseError:
        raise  # another process has made it in the meantime
    except BaseException:
        if is_new and not run.has_begun:
            shutil.rmtree(run.directory, ignore_errors=True)
        raise


@contextmanager
def _named_memory(config: DictConfig) -> Iterator[None]:
    """Name the settings that need memory, where there is not enough of it."""
    try:
        yield
    except Exception as error:
        # torch raises a RuntimeError for main memory
        is_short = isinstance(error, MemoryError | torch.OutOfMemoryError)
        if not (is_short or re.search("allocat.* memory", str(error))):
            raise
        raise MemoryError(
            f"There is not enough memory with frames_per_batch={config.frames_per_batch}, "
            f"num_envs={config.num_envs} and these networks: lower them."
        ) from error


@contextmanager
def _during_training() -> Iterator[None]:
    """Mark errors that no setting explains: users see their traceback."""
    try:
        yield
    except Exception as error:
        if not isinstance(error, _WHILE_TRAINING):
            error.add_note(_UNEXPECTED)
        raise


def _check_is_free(run: Run, again: str, key: str) -> None:
    """Refuse a folder with files that a new run would replace."""
    # of a run, of an exported policy, or the user's own
    places = (run.table_file, run.config_file, run.checkpoints_folder, run.robot_folder)
    taken = [place for place in (*places, run.transitions_folder) if place.exists()]
    if taken and not run.has_begun:
        raise FileExistsError(f"The run would replace {taken[0]}: give it another folder, {key}=…")
    if taken:
        raise FileExistsError(
            f"{run.directory} already holds a run. Continue it with: {again}; or give this one "
            f"another folder, {key}=…"
        )


def _prepare(
    config: DictConfig,
    run: Run,
    continues: bool,
    callbacks: Sequence[Callback],
    say: Callable[[str], None],
) -> Trainer:
    """Build a run, or continue the one in the folder, and print what the user has to know."""
    if "RL_LOGGING_LEVEL" not in os.environ:  # which users set to see more of TorchRL's notes
        for library in ("torchrl", "tensordict"):
            logging.getLogger(library).setLevel(logging.WARNING)
    if not (isinstance(callbacks, list | tuple) and all(map(callable, callbacks))):
        raise ConfigError(f"callbacks must be a list of functions, [f], got {callbacks!r}.")
    if config.frames % config.frames_per_batch:
        whole = math.ceil(config.frames / config.frames_per_batch) * config.frames_per_batch
        print(f"Training for {whole:,} frames: whole batches of {config.frames_per_batch:,}.")
    seed_everything(config.seed, config.num_threads)
    trainer = _build(config, run)
    trainer.callbacks = callbacks
    algorithm = trainer.algorithm
    if algorithm.learns_from:
        print(algorithm.learns_from)
    if algorithm.schedule:
        say(algorithm.schedule)
    if continues and trainer.resume():
        print(f"Resuming after {trainer.progress.steps:,} of {config.frames:,} frames.")
        if trainer.begins_anew:
            print("The state of its environments is not stored: they begin new episodes.")
        if algorithm.lost_on_resume:
            print(algorithm.lost_on_resume)
        return trainer
    if continues and run.num_rows:
        print("No checkpoint was written yet: starting over, with a new progress.csv.")
    if config.init_from is not None:
        taken = begin_from(algorithm, config, trainer.interface)
        new = [name for name in algorithm.networks if name not in taken]
        print(f"From {config.init_from}: {', '.join(taken)}; new: {', '.join(new) or 'none'}.")
    if not (continues and run.robot_file.exists()):
        keep_robot(run, _plain(config.env))
    return trainer


def _build(config: DictConfig, run: Run) -> Trainer:
    node = robot_of(run, _plain(config.env))
    make = partial(
        make_env,
        node,
        device=config.device,
        seed=config.seed,
        num_threads=physics_threads(config),
        transforms=transforms_of(config),
    )
    in_workers = partial(_make_after_imports, trust.allowed(), list(sys.path), make)
    env = make(num_envs=config.num_envs)
    evaluation, periodic = None, config.get("evaluation")
    if periodic is not None:
        evaluation = partial(
            periodic_evaluation,
            partial(make, evaluating=True),
            cost_keys=env.cost_keys,
            seed=default_seed(node, config.seed),
            fixed_layout=has_fixed_layout(node),
            interval=periodic.interval,
            episodes=periodic.episodes,
        )
    return build_trainer(config, env, run.directory, in_workers, evaluation)


def _make_after_imports(
    modules: Sequence[str], path: list[str], make: Callable[..., Any], **options: Any
) -> Any:
    """Make environments in a worker process, which imports the user's modules first."""
    sys.path[:] = path
    for name in modules:
        import_module(name)
        trust.allow(name)
    return make(**options)


def _write_notes(run: Run, config: DictConfig, hydra: DictConfig) -> None:
    """Write Hydra's notes; Hydra itself would write them before the run is known to begin."""
    run.notes_folder.mkdir(exist_ok=True)
    notes = (
        (run.composed_file, config),
        (run.overrides_file, hydra.overrides.task),
        (run.hydra_file, OmegaConf.create({"hydra": hydra})),
    )
    for path, content in notes:
        with replacing(path) as unfinished:
            OmegaConf.save(content, unfinished)


def _is_to_be_certified(
    run: Run, config: DictConfig, length: int, is_constrained: bool, say: Callable[[str], None]
) -> bool:
    """Whether a finished run has limits, is long enough, and has no certificate of its end."""
    transforms = (config.get("transforms") or {}).values()
    if not (is_constrained or any("budgets" in transform for transform in transforms)):
        return False
    # steps of a test that stops early, after a fifth of its episodes
    steps = int(config.get("certificate", {}).get("episodes", 0) * length / 5)
    newest, certificate = run.newest_checkpoint(), run.certificate
    tested = (certificate or {}).get("candidates") or ()
    is_certified = newest is not None and checkpoint_steps(newest) in tested
    if not steps or is_certified:
        return False
    if steps > config.frames:
        say(
            f"Not certified: frames={config.frames:_} are fewer than {steps:,}, a fifth of the "
            f"steps of certificate.episodes={config.certificate.episodes} episodes. To make a "
            "certificate all the same: safe-rl evaluate "
            f"{quote(str(run.directory))} certify=true{_imports(config)}"
        )
    return steps <= config.frames


def _certify(run: Run, config: DictConfig, again: str, say: Callable[[str], None]) -> None:
    try:
        threads, changes = config.num_threads or 0, config.certificate
        certificate = certify_run(run.directory, num_threads=threads, changes=changes)
    except KeyboardInterrupt:
        _end(SIGINT, f"Interrupted before it was certified. To do so: {again}")
    say(str(certificate))
    if certificate is not None and certificate.checkpoint is None:
        say(f"To train on: {again} frames={2 * config.frames:_}")


def _end(stopped: Signals | None, line: str) -> None:
    """End the process if a signal asks for it, with a line about how to go on."""
    if stopped is not None:
        _print(line)
        raise SystemExit(128 + stopped)


def _print(line: str) -> None:
    """Print a line, unless the terminal was closed; that may have ended the run."""
    try:
        print(line, flush=True)
    except OSError:
        # Python would flush the buffered line again at exit, and change the exit status
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
