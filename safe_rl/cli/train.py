"""The command ``train.py``: compose a configuration, build a run, train."""

import math
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict

from safe_rl.cli.certificates import certify_run, is_worth_a_certificate
from safe_rl.cli.composing import check_command
from safe_rl.cli.conf import CONF
from safe_rl.cli.overrides import CommandLineError
from safe_rl.cli.run_folders import write_notes
from safe_rl.cli.settings import SETTING_ERRORS, SettingError, check_settings, errors_in_a_line
from safe_rl.cli.shorthands import expand_arguments
from safe_rl.cli.user_code import (
    import_modules,
    imported,
    make_after_imports,
    note_imports,
    split_imports,
)
from safe_rl.envs import ConfigError, LayoutError, complete_env, make_env, store_configs
from safe_rl.evaluation.loading import transforms_of
from safe_rl.runs.folder import RunFolder
from safe_rl.runs.lock import held
from safe_rl.runs.resuming import is_finished, may_continue
from safe_rl.targets import TargetError
from safe_rl.training.trainer import Trainer, build_trainer, physics_threads, seed_everything
from safe_rl.training.transfer import initialise_networks

store_configs()


def prepare(config: DictConfig, directory: Path, continues: bool) -> Trainer | None:
    """Build a run, or go on with the one in the folder; None if that is finished."""
    if not continues:
        RunFolder(directory).check_is_free()
    check_settings(config)
    if continues and is_finished(directory, config.frames):
        print(f"{directory} has its {config.frames:,} frames already: raise 'frames' to train on.")
        return None
    if config.frames % config.frames_per_batch:
        whole = math.ceil(config.frames / config.frames_per_batch) * config.frames_per_batch
        print(f"Training for {whole:,} frames: whole batches of {config.frames_per_batch:,}.")
    seed_everything(config.seed, config.num_threads)
    make = partial(
        make_env,
        cast(dict[str, Any], OmegaConf.to_container(config.env, resolve=True)),
        device=config.device,
        seed=config.seed,
        num_threads=physics_threads(config),
        transforms=transforms_of(config),
    )
    in_workers = partial(make_after_imports, imported(), make)
    trainer = build_trainer(config, make(num_envs=config.num_envs), directory, in_workers)
    if continues and trainer.resume():
        print(f"Going on after {trainer.progress.steps:,} of {config.frames:,} frames.")
        if trainer.begins_anew:
            print("The state of its environments is not stored: they begin new episodes.")
        return trainer
    if continues and trainer.folder.files.num_rows:
        print("No checkpoint was written yet: starting over, with a new progress.csv.")
    if config.init_from is not None:
        algorithm = trainer.algorithm
        initialise_networks(algorithm.networks, Path(config.init_from), list(algorithm.cost_keys))
    return trainer


def complete(config: DictConfig) -> None:
    """Fill the environment's keys up, so that the run's folder tells all of them."""
    with open_dict(config):
        config.env = complete_env(
            cast(dict[str, Any], OmegaConf.to_container(config.env, resolve=True))
        )


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def train(config: DictConfig) -> None:
    """Compose, build, train."""
    folder = RunFolder(Path(HydraConfig.get().runtime.output_dir))
    is_job = HydraConfig.get().mode is RunMode.MULTIRUN  # whose sweep keeps account of failures
    with nullcontext() if is_job else errors_in_a_line(folder.directory, True, *SETTING_ERRORS):
        complete(config)
    continues = may_continue(HydraConfig.get(), config)

    def in_a_line(*errors: type[Exception]) -> AbstractContextManager[None]:
        within = errors_in_a_line(folder.directory, not continues, *errors)
        return nullcontext() if is_job else within

    with ExitStack() as stack:
        with in_a_line(*SETTING_ERRORS, LayoutError, FileExistsError):
            stack.enter_context(held(folder))
            trainer = prepare(config, folder.directory, continues)
        if trainer is None:
            return
        with in_a_line(OSError):
            if not continues or (is_job and not folder.notes.exists()):
                write_notes(folder, config)
            print(trainer.run())
    if trainer.interrupted_by is not None:
        print(f"Interrupted. Continue with: python train.py resume={folder.directory}")
        raise SystemExit(128 + trainer.interrupted_by)
    if trainer.algorithm.cost_keys and is_worth_a_certificate(config, trainer.episode_length):
        print(certify_run(folder.directory, num_threads=config.num_threads or 0))


def main(arguments: Sequence[str] | None = None) -> int:
    """The command: expand shorthands, check what is asked for, and hand over to Hydra."""
    try:
        given = sys.argv[1:] if arguments is None else list(arguments)
        modules, given = split_imports(given)
        if modules is not None:
            import_modules(modules)
            given = note_imports(modules, given)
        expanded = expand_arguments(given)
        check_command(expanded, CONF)
    except (CommandLineError, SettingError, TargetError, ConfigError) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        print(error, file=sys.stderr)
        return 1
    sys.argv[1:] = expanded
    train()
    return 0
