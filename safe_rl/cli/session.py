"""One run from its configuration to its certificate: for the command, sweeps and Python."""

from __future__ import annotations

import logging
import math
import os
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from shlex import quote
from signal import SIGINT
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import CheckpointError

from safe_rl.cli.composing import is_to_keep_limits
from safe_rl.cli.evaluating import certify_run
from safe_rl.cli.run_folders import keep_robot, new_folder, robot_of
from safe_rl.cli.schema import plain
from safe_rl.cli.user_code import imported, make_after_imports
from safe_rl.collectors import EpisodeError, WorkerError
from safe_rl.envs import ConfigError, ContractError, complete_env, make_env
from safe_rl.evaluation.episodes import default_seed, has_fixed_layout, periodic_evaluation
from safe_rl.evaluation.loading import transforms_of
from safe_rl.files import replacing
from safe_rl.runs.checkpoints import is_finished
from safe_rl.runs.folder import RunInUseError, lock_folder
from safe_rl.runs.identity import check_same_run
from safe_rl.runs.outcome import final_figures, violation
from safe_rl.runs.run import Run
from safe_rl.runs.table import TableError, read_table
from safe_rl.training.building import begin_from, build_trainer, physics_threads, seed_everything
from safe_rl.training.trainer import Trainer

SETTING_ERRORS: tuple[type[Exception], ...] = (
    *(ValueError, CheckpointError, OmegaConfBaseException, OSError, ModuleNotFoundError),
)
"""Errors about settings and files, raised when a run is built or evaluated."""
_TRAINING_ERRORS = (
    *(OSError, TableError, ConfigError, ContractError, EpisodeError, FloatingPointError),
    WorkerError,
)
"""Errors of training whose message is enough, so that no traceback is shown."""


class Session:
    """One run in its folder: begun or continued, trained, certified.

    Args:
        config: Its configuration, checked. Its node ``hydra``, if any, is removed; a new run writes
            it into its notes.
        folder: Its folder; None: the one that its configuration names.
        continues: Whether to continue the run in the folder.
        program: The command, as the user has called it; None: Python, where the outcome is not
            printed.
        callbacks: Called after every epoch with its row; one that returns False ends the run.
    """

    def __init__(
        self,
        config: DictConfig,
        folder: Path | None = None,
        *,
        continues: bool = False,
        program: str | None = "python train.py",
        callbacks: Sequence[Callable[[Mapping[str, float]], Any]] = (),
    ) -> None:
        # a new folder is removed if the run cannot begin
        if folder is None:
            folder, self._is_new = new_folder(config.hydra)
        else:  # Hydra has made the folder of a new run
            self._is_new = not (folder.exists() and any(folder.iterdir()))
        with open_dict(config):
            self.hydra = config.pop("hydra", None)
        self.config, self.folder = config, Run(folder)
        self._continues, self._callbacks, self._program = continues, callbacks, program
        modules = list(config.get("import") or [])
        self._imports = "".join(f" import={quote(name)}" for name in modules)
        self._again = f"{program}{self._imports} resume={quote(str(folder))}"
        if program is None:
            imports = f", imports={modules}" if modules else ""
            self._again = f"safe_rl.resume({str(folder)!r}{imports})"
        self._has_begun = False

    def run(self) -> None:
        """Train, or continue to train; at the end, certify a run that is to keep limits.

        Ctrl-C, SIGTERM or a closed terminal ends the run after the current epoch.

        Raises:
            SystemExit: If a signal has ended the run; the status is 128 and the signal's number.
            Exception: Of any type; `refuses` tells whether the message is enough for the user.
        """
        try:
            self._complete()
            is_job = self._continues and self.hydra is not None
            if is_job:  # its folder may hold a run with other settings
                check_same_run(self.folder.directory, self.config)
            with lock_folder(self.folder.lock_file):
                trainer = self._prepare()
                self._has_begun = True
                if trainer is not None:
                    if self.hydra is not None and not (
                        is_job and self.folder.notes_folder.exists()
                    ):
                        self._write_notes(self.hydra)
                    outcome = trainer.run()
        except RunInUseError:
            self._is_new = False  # another process has made it in the meantime
            raise
        finally:
            if self._is_new and not (self._has_begun or self.folder.has_begun):
                shutil.rmtree(self.folder.directory, ignore_errors=True)
        if trainer is None:
            if self.folder.certifying_file.exists():
                self._certify()
            elif not (is_job or self.folder.certificate_file.exists()):
                length = int(self.config.env.get("num_steps") or 1000)
                self._certify_if_long(length, self.config.algo.get("constrained") is not False)
            return
        self._say(outcome)
        if trainer.interrupted_by is not None:
            _print(f"Interrupted. Continue with: {self._again}")
            raise SystemExit(128 + trainer.interrupted_by)
        self._certify_if_long(trainer.episode_length, bool(trainer.algorithm.cost_keys))

    def refuses(self, error: Exception) -> bool:
        """Whether an error is about settings, files or the environment: the message is enough."""
        return isinstance(error, _TRAINING_ERRORS if self._has_begun else SETTING_ERRORS)

    def _say(self, line: str) -> None:
        if self._program is not None:
            _print(line)

    def _complete(self) -> None:
        """Add the environment's defaults to its node, so that the saved configuration has them."""
        given = plain(self.config)["env"]
        # keys that are null take the value that is found
        known = {key: value for key, value in given.items() if value is not None}
        with open_dict(self.config):
            self.config.env = complete_env(robot_of(self.folder, given)) | known

    def _prepare(self) -> Trainer | None:
        """Build the run, or continue the one in the folder; None if that is finished."""
        if "RL_LOGGING_LEVEL" not in os.environ:  # which users set to see more of TorchRL's notes
            for library in ("torchrl", "tensordict"):
                logging.getLogger(library).setLevel(logging.WARNING)
        config, folder, callbacks = self.config, self.folder, self._callbacks
        if not (isinstance(callbacks, list | tuple) and all(map(callable, callbacks))):
            raise ConfigError(f"callbacks must be a list of functions, [f], got {callbacks!r}.")
        # of a run, of an exported policy, or the user's own, which this run would replace
        places = (
            folder.table_file,
            folder.config_file,
            folder.checkpoints_folder,
            folder.robot_folder,
            folder.transitions_folder,
        )
        taken = next((place for place in places if place.exists()), None)
        if not self._continues and taken is not None:
            key = "hydra.run.dir" if self._program else "directory"
            if not folder.has_begun:
                raise FileExistsError(
                    f"The run would replace {taken}: give it another folder, {key}=…"
                )
            raise FileExistsError(
                f"{folder.directory} already holds a run. Continue it with: {self._again}; or give "
                f"this one another folder, {key}=…"
            )
        if self._continues and is_finished(folder.checkpoints("last"), config.frames):
            more = ": raise 'frames' to train on"
            if folder.certifying_file.exists():
                more = "; certifying it, as was begun"
            print(f"{folder.directory} has its {config.frames:,} frames already{more}.")
            return None
        if config.frames % config.frames_per_batch:
            whole = math.ceil(config.frames / config.frames_per_batch) * config.frames_per_batch
            print(f"Training for {whole:,} frames: whole batches of {config.frames_per_batch:,}.")
        seed_everything(config.seed, config.num_threads)
        trainer = self._build()
        trainer.callbacks = callbacks
        if trainer.algorithm.learns_from:
            print(trainer.algorithm.learns_from)
        if trainer.algorithm.schedule:
            self._say(trainer.algorithm.schedule)
        if self._continues and trainer.resume():
            print(f"Resuming after {trainer.progress.steps:,} of {config.frames:,} frames.")
            if trainer.begins_anew:
                print("The state of its environments is not stored: they begin new episodes.")
            if trainer.algorithm.lost_on_resume:
                print(trainer.algorithm.lost_on_resume)
            return trainer
        if self._continues and folder.num_rows:
            print("No checkpoint was written yet: starting over, with a new progress.csv.")
        if config.init_from is not None:
            begin_from(trainer.algorithm, config, trainer.interface)
        if not (self._continues and folder.robot_file.exists()):
            keep_robot(folder, plain(config)["env"])
        return trainer

    def _build(self) -> Trainer:
        config, env = self.config, robot_of(self.folder, plain(self.config)["env"])
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
        evaluation, periodic = None, config.get("evaluation")
        if periodic is not None:
            evaluation = partial(
                periodic_evaluation,
                partial(make, evaluating=True),
                cost_keys=training.cost_keys,
                seed=default_seed(env, config.seed),
                fixed_layout=has_fixed_layout(env),
                interval=periodic.interval,
                episodes=periodic.episodes,
            )
        return build_trainer(config, training, self.folder.directory, in_workers, evaluation)

    def _write_notes(self, hydra: DictConfig) -> None:
        """Write Hydra's notes; Hydra itself would write them before the run is known to begin."""
        folder = self.folder
        folder.notes_folder.mkdir(exist_ok=True)
        notes = ((folder.composed_file, self.config), (folder.overrides_file, hydra.overrides.task),
                 (folder.hydra_file, OmegaConf.create({"hydra": hydra})))  # fmt: skip
        for path, content in notes:
            with replacing(path) as unfinished:
                OmegaConf.save(content, unfinished)

    def _certify_if_long(self, episode_length: int, is_constrained: bool) -> None:
        config = self.config
        if not is_to_keep_limits(config, is_constrained):
            return
        # steps of a test that stops early, after a fifth of its episodes
        steps = int(config.get("certificate", {}).get("episodes", 0) * episode_length / 5)
        if 0 < steps <= config.frames:
            self._certify()
        elif steps:
            self._say(
                f"Not certified: frames={config.frames:_} are fewer than {steps:,}, a fifth of the "
                f"steps of certificate.episodes={config.certificate.episodes} episodes. To make a "
                "certificate all the same: python -m safe_rl.evaluate "
                f"{quote(str(self.folder.directory))} certify=true{self._imports}"
            )

    def _certify(self) -> None:
        """Certify the run; if this is interrupted, a file remains, and resuming certifies it."""
        folder = self.folder
        try:
            with lock_folder(folder.lock_file):
                folder.certifying_file.touch()
                threads, changes = self.config.num_threads or 0, self.config.certificate
                certificate = certify_run(folder.directory, num_threads=threads, changes=changes)
        except KeyboardInterrupt:
            self._say(f"Interrupted before it was certified. To do so: {self._again}")
            raise SystemExit(128 + SIGINT) from None
        self._say(str(certificate))
        if certificate is not None and certificate.checkpoint is None:
            self._say(f"To train on: {self._again} frames={2 * self.config.frames:_}")


def run_job(config: DictConfig, hydra: DictConfig) -> float:
    """Run one job of a sweep; Hydra has composed both nodes in the job's process.

    Returns:
        The value that an optimising sweeper maximises: the run's final return, or −∞ if it ends
        above a limit or no episode has ended.

    Raises:
        SystemExit: If it is interrupted.
        ValueError: If its folder holds a run with other settings.
    """
    folder = Run(Path(hydra.runtime.output_dir).resolve())
    Session(config, folder.directory, continues=True).run()
    limits = dict(config.cost_limits)
    figures = final_figures(read_table(folder.table_file), list(limits))
    value = figures["episode_return"]
    is_above = any(violation(figures, key, limit) > 0 for key, limit in limits.items())
    return -math.inf if is_above or math.isnan(value) else value


def _print(line: str) -> None:
    """Print a line, unless the terminal was closed; that may have ended the run."""
    try:
        print(line, flush=True)
    except OSError:
        # Python would flush the buffered line again at exit, and change the exit status
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
