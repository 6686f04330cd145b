"""A composed configuration becomes a run: build it, or go on with it, train, certify."""

from __future__ import annotations

import logging
import math
import os
import sys
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import partial
from pathlib import Path
from signal import SIGINT
from typing import Any, cast

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from safe_rl.cli.certificates import (
    certify_ended,
    is_to_keep_limits,
    is_worth_a_certificate,
    train_on,
    why_not_certified,
)
from safe_rl.cli.failures import SETTING_ERRORS, errors_in_a_line
from safe_rl.cli.interrupting import say_if_heard
from safe_rl.cli.robots import keep_robot, robot_of
from safe_rl.cli.run_folders import write_notes
from safe_rl.cli.settings import check_settings
from safe_rl.cli.user_code import imported, make_after_imports
from safe_rl.envs import ConfigError, LayoutError, complete_env, make_env
from safe_rl.evaluation.during import PeriodicEvaluation
from safe_rl.evaluation.layouts import default_seed, has_fixed_layout
from safe_rl.evaluation.loading import transforms_of
from safe_rl.runs.checkpoints import is_finished
from safe_rl.runs.folder import RunFolder, lock_folder
from safe_rl.runs.identity import may_continue
from safe_rl.runs.table import TableError
from safe_rl.training.building import begin_from, build_trainer, physics_threads, seed_everything
from safe_rl.training.trainer import EpisodeError, Trainer

__all__ = ["complete", "prepare", "run"]


def prepare(config: DictConfig, directory: Path, continues: bool) -> Trainer | None:
    """Build a run, or go on with the one in the folder; None if that is finished."""
    if "RL_LOGGING_LEVEL" not in os.environ:  # by which users let TorchRL say more
        logging.getLogger("torchrl").setLevel(logging.WARNING)
    folder = RunFolder(directory)
    if not continues:
        folder.check_is_free()
    check_settings(config, folder if continues else None)
    if continues and is_finished(directory, config.frames):
        was_interrupted = folder.certifying.exists()  # before it was certified
        what = (
            "; certifying it, as was begun" if was_interrupted else ": raise 'frames' to train on"
        )
        print(f"{directory} has its {config.frames:,} frames already{what}.")
        return None
    if config.frames % config.frames_per_batch:
        whole = math.ceil(config.frames / config.frames_per_batch) * config.frames_per_batch
        print(f"Training for {whole:,} frames: whole batches of {config.frames_per_batch:,}.")
    seed_everything(config.seed, config.num_threads)
    given = cast(dict[str, Any], OmegaConf.to_container(config.env, resolve=True))
    env, notice = robot_of(folder, given) if continues else (given, None)
    if notice:
        print(notice)
    make = partial(
        make_env,
        env,
        device=config.device,
        seed=config.seed,
        num_threads=physics_threads(config),
        transforms=transforms_of(config),
    )
    in_workers = partial(make_after_imports, imported(), make)
    training = make(num_envs=config.num_envs)
    evaluation = None
    if config.get("evaluation") is not None:
        evaluation = partial(
            PeriodicEvaluation,
            partial(make, evaluating=True),
            cost_keys=training.cost_keys,
            seed=default_seed(env, config.seed),
            fixed_layout=has_fixed_layout(env),
            interval=config.evaluation.interval,
            episodes=config.evaluation.episodes,
        )
    trainer = build_trainer(config, training, directory, in_workers, evaluation)
    if trainer.algorithm.learns_from:
        print(trainer.algorithm.learns_from)
    if continues and trainer.resume():
        print(f"Going on after {trainer.progress.steps:,} of {config.frames:,} frames.")
        if trainer.begins_anew:
            print("The state of its environments is not stored: they begin new episodes.")
        if trainer.algorithm.lost_on_resume:
            print(trainer.algorithm.lost_on_resume)
        return trainer
    if continues and trainer.record.folder.num_rows:
        print("No checkpoint was written yet: starting over, with a new progress.csv.")
    if config.init_from is not None:
        begin_from(trainer.algorithm, config)
    if not (continues and folder.robot_note.exists()):
        keep_robot(folder, given)
    return trainer


def complete(config: DictConfig, folder: RunFolder) -> None:
    """Fill the environment's keys up, so that the run's folder tells all of them."""
    given = cast(dict[str, Any], OmegaConf.to_container(config.env, resolve=True))
    with open_dict(config):
        full = complete_env(robot_of(folder, given)[0])
        # what is given as null has been found out
        config.env = full | {key: value for key, value in given.items() if value is not None}


def run(config: DictConfig) -> None:
    """Train, or go on training, in the folder that Hydra has chosen.

    Raises:
        SystemExit: with one line for what is wrong with settings or files, or when interrupted.
    """
    folder = RunFolder(Path(HydraConfig.get().runtime.output_dir))
    is_job = HydraConfig.get().mode is RunMode.MULTIRUN  # whose sweep keeps account of failures
    with nullcontext() if is_job else errors_in_a_line(folder.directory, True, *SETTING_ERRORS):
        complete(config, folder)
    continues = may_continue(HydraConfig.get(), config)

    def in_a_line(*errors: type[Exception]) -> AbstractContextManager[None]:
        within = errors_in_a_line(folder.directory, not continues, *errors)
        return nullcontext() if is_job else within

    with ExitStack() as stack:
        with in_a_line(*SETTING_ERRORS, LayoutError, FileExistsError):
            stack.enter_context(lock_folder(folder))
            trainer = prepare(config, folder.directory, continues)
        if trainer is None:
            if folder.certifying.exists():
                _say_certificate(config, folder)
            return
        # the last two are about the environment: where they stand says less than the message
        with in_a_line(OSError, TableError, ConfigError, EpisodeError, FloatingPointError):
            if not continues or (is_job and not folder.notes.exists()):
                write_notes(folder, config, HydraConfig.get())
            outcome = trainer.run()
    if trainer.interrupted_by is not None:
        say_if_heard(outcome, f"Interrupted. Continue with: {_again(folder)}")
        raise SystemExit(128 + trainer.interrupted_by)
    print(outcome)
    if not is_to_keep_limits(config, trainer.algorithm.cost_keys):
        return
    if is_worth_a_certificate(config, trainer.episode_length):
        _say_certificate(config, folder)
    elif reason := why_not_certified(config, trainer.episode_length, folder.directory):
        print(reason)


def _this_command() -> str:
    """What trains, as the user has called it."""
    return sys.argv[0] if sys.argv[0].startswith("safe-rl") else "python train.py"


def _again(folder: RunFolder) -> str:
    return f"{_this_command()} {folder.resuming}"


def _say_certificate(config: DictConfig, folder: RunFolder) -> None:
    try:
        certificate = certify_ended(folder.directory, config.num_threads or 0)
    except KeyboardInterrupt:
        print(f"Interrupted before it was certified. To do so: {_again(folder)}")
        raise SystemExit(128 + SIGINT) from None
    print(certificate)
    if certificate is not None and certificate.checkpoint is None:
        print(f"To train on: {_this_command()} {train_on(config, folder.directory)}")
