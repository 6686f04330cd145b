"""Train a run in its folder, or continue it; at the end, certify it if it keeps limits."""

from __future__ import annotations

import gc
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from shlex import quote
from signal import SIGINT, Signals
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import CheckpointError

from safe_rl.algorithms.algorithm_contract import Algorithm
from safe_rl.checks import UNEXPECTED, SettingError
from safe_rl.collectors import EpisodeError, WorkerError
from safe_rl.envs import ConfigError, ContractError, complete_env, make_env
from safe_rl.evaluation.certificate import has_options
from safe_rl.evaluation.certifying import certify_run
from safe_rl.evaluation.loading import keep_robot, robot_of
from safe_rl.evaluation.settings import certificate_options, has_tested_measure
from safe_rl.files import PROGRAM, print_line, replacing
from safe_rl.runs.checkpoints import is_finished
from safe_rl.runs.folder import RunInUseError, checkpoint_steps, lock_folder
from safe_rl.runs.identity import is_to_keep_limits, measure_of, whole_frames
from safe_rl.runs.run import Run
from safe_rl.runs.table import TableError
from safe_rl.training.building import begin_from, build_run, seed_everything
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


def is_expected(error: Exception) -> bool:
    """Whether an error is about settings, files or the environment: the message is enough."""
    is_known = isinstance(error, SETTING_ERRORS + _WHILE_TRAINING)
    return is_known and UNEXPECTED not in getattr(error, "__notes__", ())


@torch.enable_grad()  # a notebook may have turned gradients off
def train(
    config: DictConfig,
    directory: Path | str,
    *,
    hydra: Any = None,
    continues: bool = False,
    callbacks: Sequence[Callback] = (),
    program: str | None = PROGRAM,
) -> Run:
    """Train, or continue to train; at the end, certify a run that is to keep limits.

    Ctrl-C, SIGTERM or a closed terminal ends the run after the current epoch.

    Args:
        config: The configuration, checked.
        directory: Folder of the run.
        hydra: Hydra's settings, for the notes of a new run.
        continues: Whether to continue the run in the folder, or to begin it if there is none.
        callbacks: See `Callback`.
        program: The command, as the user has called it; None: Python, where the schedule and the
            outcome are not printed.

    Raises:
        SystemExit: If a signal has ended the run; the status is 128 and the signal's number.
        FileExistsError: If the folder of a new run holds one.
        Exception: Of any type; `is_expected` tells whether the message is enough for the user.
    """
    # Python shows the outcome of the run that is returned
    run, say = Run(directory), print_line if program else lambda line: None
    complete(config, run)
    again = partial(_command_again, run, config, program)
    with _ending_cleanly(run, config), _alone(run), lock_folder(run.lock_file):
        if continues and is_finished(run.checkpoints("last"), config.frames):
            done = f"{run.directory} has {run.steps:,} frames already"
            print(f"{done}. To train on: {again(2 * max(run.steps, config.frames))}")
            with closing(make_env(robot_of(run, config.env), num_envs=1)) as env:
                stopped_by, length = None, env.max_episode_steps
        else:
            if not continues:
                _check_is_free(run, again, "hydra.run.dir" if program else "directory")
            trainer = _prepare(config, run, continues, callbacks, say)
            if hydra is not None and not (continues and run.notes_folder.exists()):
                _write_notes(run, config, hydra)
            try:
                say(trainer.run())
            except Exception as error:
                # users see the traceback of an error that no setting explains
                if not isinstance(error, _WHILE_TRAINING):
                    error.add_note(UNEXPECTED)
                raise
            stopped_by, length = trainer.stopped_by, trainer.env.max_episode_steps
            if not trainer.is_finished:
                end_by(stopped_by, f"Interrupted. Continue with: {again()}")
            del trainer  # the test does not need its replay buffer, which may have gigabytes
            gc.collect()  # it is part of a cycle
        if is_to_keep_limits(config):
            certify_finished(run, config, length, stopped_by=stopped_by, again=again, say=say)
    return run


_TRAINED: dict[int, Run] = {}  # process -> the run that it trains; a fork trains none


@contextmanager
def _alone(run: Run) -> Iterator[None]:
    """Refuse to train twice at a time in one process, which has one generator of random numbers."""
    if _TRAINED.setdefault(os.getpid(), run) is not run:
        raise RunInUseError(
            f"{run.directory}: this process trains a run already, and both would draw from one "
            "generator. Train one after the other, or in processes of their own, as a sweep does."
        )
    try:
        yield
    finally:
        del _TRAINED[os.getpid()]


def complete(config: DictConfig, run: Run) -> None:
    """Add the defaults of an environment to its node, for the saved configuration."""
    given: Any = OmegaConf.to_container(config.env, resolve=True)
    # keys that are null take the value that is found
    known = {key: value for key, value in given.items() if value is not None}
    with open_dict(config):
        config.env = complete_env(robot_of(run, config.env)) | known


def _command_again(
    run: Run, config: DictConfig, program: str | None, frames: int | None = None
) -> str:
    """The command that continues a run, or the call in Python, with ``frames`` if given."""
    more = [] if frames is None else [f"frames={frames:_}"]
    if program is not None:
        words = [f"{program}{import_words(config)}", f"resume={quote(str(run.directory))}", *more]
        return " ".join(words)
    modules = list(config.get("import") or [])
    imports = [f"imports={modules}"] if modules else []
    return f"safe_rl.resume({', '.join([repr(str(run.directory)), *imports, *more])})"


@contextmanager
def _ending_cleanly(run: Run, config: DictConfig) -> Iterator[None]:
    """Remove a new folder if its run cannot begin, and name the settings that need memory."""
    is_new = not run.directory.exists() or not any(run.directory.iterdir())
    try:
        yield
    except RunInUseError:
        raise  # another process has made the folder in the meantime
    except BaseException as error:
        if is_new and not run.has_begun:
            shutil.rmtree(run.directory, ignore_errors=True)
        # torch raises a RuntimeError for main memory
        is_short = isinstance(error, MemoryError | torch.OutOfMemoryError)
        if is_short or re.search("allocat.* memory", str(error)):
            # the replay buffer is first, because it is the largest by far
            keys = ("memory.capacity", "frames_per_batch", "num_envs")
            sizes = {key: OmegaConf.select(config, key) for key in keys}
            named = ", ".join(f"{key}={size}" for key, size in sizes.items() if size is not None)
            raise MemoryError(
                f"There is not enough memory with {named} and these networks: lower them."
            ) from error
        raise


def _check_is_free(run: Run, again: Callable[[], str], key: str) -> None:
    """Refuse a folder with files that a new run would replace."""
    # of a run, of an exported policy, or the user's own
    places = (run.table_file, run.config_file, run.checkpoints_folder, run.robot_folder)
    taken = [place for place in (*places, run.transitions_folder) if place.exists()]
    if taken and not run.has_begun:
        raise FileExistsError(f"The run would replace {taken[0]}: give it another folder, {key}=…")
    if taken:
        raise FileExistsError(
            f"{run.directory} already holds a run. Continue it with: {again()}; or give this one "
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
    if config.frames < (frames := whole_frames(config)):
        print(f"Training for {frames:,} frames: whole batches of {config.frames_per_batch:,}.")
    seed_everything(config.seed, config.num_threads)
    trainer = build_run(config, run)
    trainer.callbacks = callbacks
    algorithm = trainer.algorithm
    _announce(algorithm, config, say)
    if continues and trainer.resume():
        print(f"Resuming after {trainer.progress.steps:,} of {frames:,} frames.")
        if trainer.snapshot is None:
            print("The state of its environments is not stored: they begin new episodes.")
        if algorithm.lost_on_resume:
            print(algorithm.lost_on_resume)
    else:
        if continues and run.num_rows:
            print("No checkpoint was written yet: starting over, with a new progress.csv.")
        if config.init_from is not None:
            taken = begin_from(algorithm, config, trainer.env.interface)
            new = [name for name in algorithm.networks if name not in taken]
            print(f"From {config.init_from}: {', '.join(taken)}; new: {', '.join(new) or 'none'}.")
        if not (continues and run.robot_file.exists()):
            keep_robot(run, config.env)
    length = trainer.env.max_episode_steps
    if frames < (first := config.num_envs * length):
        print_line(
            f"No episode will reach its last step: {config.num_envs} environments with episodes of "
            f"{length:,} steps reach it after {first:,} frames. Set frames=… or num_envs=…"
        )
    return trainer


def _announce(algorithm: Algorithm, config: DictConfig, say: Callable[[str], None]) -> None:
    """Print what an algorithm learns from, and when its limits begin to hold."""
    if algorithm.learns_from:
        print(algorithm.learns_from)
    if algorithm.schedule:
        say(algorithm.schedule)
        planned = OmegaConf.select(config, "limits.frames")
        if planned is not None and whole_frames(config) < planned:
            say(
                f"This schedule was made for {planned:,} frames. If the limits are to fall sooner: "
                f"limits.frames={config.frames:_}"
            )
    if config.cost_limits and not is_to_keep_limits(config):
        print_line(f"algo={config.algo.name} does not keep cost_limits: they are only reported.")


def _write_notes(run: Run, config: DictConfig, hydra: Any) -> None:
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


def certify_finished(
    run: Run,
    config: DictConfig,
    length: int,
    *,
    stopped_by: Signals | None,
    again: Callable[..., str],
    say: Callable[[str], None],
) -> None:
    """Certify a finished run that is to keep limits, unless it is short or tested already.

    A tested one is tested again if the configuration has other options for the test. `length` is
    T_ep, steps of a full episode. `stopped_by`, a signal that has come in the last epoch, ends the
    process before the test. `again` returns the command that continues the run, also with more
    frames; `say` prints a line.
    """
    # steps of a test that stops early, after a fifth of its episodes
    steps = int(config.certificate.episodes * length / 5)
    newest, certificate = run.newest_checkpoint(), run.certificate or {}
    tested = certificate.get("candidates") or ()
    is_tested = newest is not None and checkpoint_steps(newest) in tested
    # a certificate with the options of `safe-rl evaluate` stays if the run's own are unchanged
    is_unchanged = config.certificate == run.config.certificate
    has_same_options = is_unchanged or has_options(certificate, certificate_options(config))
    if not steps or (is_tested and has_same_options):
        return
    reason = None
    if not has_tested_measure(config):
        reason = f"there is no test for limits on {measure_of(config)}. To test the mean cost"
    elif steps > whole_frames(config):
        reason = (
            f"frames={config.frames:_} are fewer than {steps:,}, a fifth of the steps of "
            f"certificate.episodes={config.certificate.episodes} episodes. To test it all the same"
        )
    if reason is not None:
        given = "" if is_unchanged else f" certificate.episodes={config.certificate.episodes}"
        command = f"safe-rl certify {quote(str(run.directory))}{given}"
        say(f"Not certified: {reason}: {command}{import_words(config)}")
        return
    later = f"Interrupted before it was certified. To do so: {again()}"
    end_by(stopped_by, later)
    threads, changes = config.num_threads or 0, config.certificate
    try:
        result = certify_run(run.directory, num_threads=threads, changes=changes)
    except KeyboardInterrupt:
        return end_by(SIGINT, later)
    say(str(result))
    if result is not None and result.checkpoint is None and result.may_need_training:
        say(f"To train on: {again(2 * config.frames)}")


def import_words(config: DictConfig) -> str:
    """The words ``import=…`` of a run's modules, each after a space."""
    return "".join(f" import={quote(name)}" for name in config.get("import") or [])


def end_by(signal: Signals | None, line: str) -> None:
    """End the process if a signal asks for it, with a line about how to go on."""
    if signal is not None:
        print_line(line)
        raise SystemExit(128 + signal)
