"""The command ``train.py``: its words, and what they make: a run, a sweep, or what Hydra shows.

What trains is imported when a run begins, so that help and refusals come at once.
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from hydra.core.utils import configure_log
from hydra.errors import HydraException
from omegaconf import DictConfig

from safe_rl.cli.composing import (
    compose_jobs,
    compose_resumed,
    hydra_on_conf,
    resolving,
    search_folders,
)
from safe_rl.cli.grammar import (
    CommandLineError,
    say_interruptions,
    split_imports,
    take_word,
)
from safe_rl.cli.user_code import import_modules, note_imports
from safe_rl.envs import store_configs
from safe_rl.naming import did_you_mean
from safe_rl.scores.benchmark import SLATES

__all__ = ["Command", "expand_slate", "job", "main", "read_command"]

if TYPE_CHECKING:
    from safe_rl.cli.session import Session

store_configs()  # also in the processes of a sweep, which import this module for `job`

_FLAGS: dict[str, tuple[str, dict[str, Any]]] = {
    "--help -h": ("show environments, algorithms and all settings", {}),
    "--hydra-help": ("show these flags and Hydra's settings", {}),
    "--version": ("show Hydra's version", {}),
    "--shell-completion -sc": ("tab completion: -sc install=bash", {}),
    "--multirun -m": ("a sweep: a run for every combination of values", {}),
    "--config-dir -cd": ("folder with YAML files of yours; may be repeated", {"action": "append"}),
    "--cfg -c": ("show the configuration", {"choices": ("job", "hydra", "all")}),
    "--package -p": ("with --cfg: show only this part", {"action": "store"}),
    "--resolve": ("with --cfg: show values, not references", {}),
    "--info -i": ("show what Hydra has found", {"nargs": "?", "const": "all"}),
}
"""Flag and its short form -> what it does, and how it is read unless it is a switch."""


class Command(NamedTuple):
    """What a command line asks for.

    Attributes:
        flags: Flags by their long names, with underscores.
        overrides: Overrides, with shorthands written out.
        run: Folder of the run that is continued, if one is.
        configs: What was composed and checked, with Hydra's own node for a new run: one, or of a
            sweep the jobs in which every value occurs; none of a question to Hydra.
    """

    flags: Namespace
    overrides: list[str]
    run: Path | None = None
    configs: Sequence[DictConfig] = ()

    @property
    def is_question(self) -> bool:
        """Whether Hydra answers it, without a configuration being checked."""
        flags = self.flags
        return flags.help or flags.hydra_help or flags.version or flags.shell_completion

    @property
    def is_shown(self) -> bool:
        """Whether a configuration is shown."""
        return bool(self.flags.cfg or self.flags.info)

    @property
    def is_sweep(self) -> bool:
        """Whether its overrides may have several values each."""
        return self.flags.multirun or "hydra.mode=MULTIRUN" in self.overrides


def read_command(words: Sequence[str]) -> Command:
    """Read a command line, and compose and check what it asks for, before anything is written.

    Args:
        words: Of ``train.py``.

    Raises:
        CommandLineError: For a word that cannot be used; the message says what to write instead.
        ValueError: For a value that a run, a part or an environment cannot have.

    Examples:
        >>> read_command(["slate=SGPoint", "-m", "seed=0"]).configs[0].env.name
        'PointGoal1'
    """
    flags, unknown = _parser().parse_known_intermixed_args(words)
    if unknown:
        name, _, value = unknown[0].lstrip("-").partition("=")
        raise CommandLineError(
            f"'{unknown[0]}': there is no such flag. A key is written without dashes, "
            f"{name.replace('-', '_')}={value or '…'}; 'python train.py --hydra-help' names "
            "the flags."
        )
    command = Command(flags, flags.overrides)
    if command.is_question:
        return command
    modules, overrides = split_imports(command.overrides)
    import_modules(modules or ())
    resume, overrides = take_word("resume", overrides)
    if resume is not None:
        if command.is_sweep or command.is_shown:
            raise CommandLineError(
                "resume= continues one run, which has its configuration in config.yaml: no flag "
                "goes with it. To continue a sweep, start it again as it was: finished runs are "
                "skipped, interrupted ones continue."
            )
        run = Path(resume).expanduser().absolute()
        return Command(flags, overrides, run, [compose_resumed(run, overrides, modules)])
    overrides = expand_slate(overrides, command.is_sweep)
    overrides = search_folders(flags.config_dir or (), overrides) + note_imports(modules)
    if command.is_sweep and not command.is_shown:
        overrides = _with_launcher(overrides)
    configs = compose_jobs(overrides, sweep=command.is_sweep, shown=command.is_shown)
    return command._replace(overrides=overrides, configs=configs)


def main(arguments: Sequence[str] | None = None, program: str = "python train.py") -> int | str:
    """The command; returns its exit status, or the line with which it ends.

    Args:
        arguments: Its words; None: those of the process.
        program: How the user has called it.
    """
    say_interruptions()
    session = None
    try:
        command = read_command(sys.argv[1:] if arguments is None else arguments)
        if command.is_question or command.is_shown or command.is_sweep:
            return _ask_hydra(command)
        session = _session(command, program)
        session.run()
    except Exception as error:
        is_about_words = isinstance(error, ValueError | HydraException | OSError)
        is_expected = is_about_words if session is None else session.refuses(error)
        if not is_expected or os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        return " ".join(str(error).split())
    return 0 if session.interrupted_by is None else 128 + session.interrupted_by


def _session(command: Command, program: str) -> Session:
    from safe_rl.cli.session import Session

    (config,) = command.configs
    if command.run is None:
        own = config.hydra
        session = Session.begin(config, program=program)
    else:
        session = Session(config, command.run, continues=True, program=program)
        words = [word for word in command.overrides if word.startswith("hydra.")]
        own = compose_jobs(words, shown=True)[0].hydra
    configure_log(own.job_logging, own.verbose)
    return session


def job(config: DictConfig) -> float:
    """One job of a sweep, in the process in which its launcher lets it run."""
    from safe_rl.cli.session import run_job

    return run_job(config)


class _Parser(ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise CommandLineError(f"{message[:1].upper()}{message[1:]}.")


def _parser() -> ArgumentParser:
    """Tells flags, which may stand anywhere, from overrides."""
    parser = _Parser(add_help=False, allow_abbrev=False)
    for names, (meaning, kind) in _FLAGS.items():
        parser.add_argument(*names.split(), help=meaning, **kind or {"action": "store_true"})
    parser.add_argument("overrides", nargs="*", help="settings, key=value")
    return parser


def expand_slate(words: Sequence[str], is_sweep: bool) -> list[str]:
    """Write ``slate=SG6`` out as the slate's environments (Ray, Achiam, Amodei 2019, section 5.1).

    Raises:
        CommandLineError: If there is no such slate, or the command cannot have it.

    Examples:
        >>> expand_slate(["slate=SGDoggo", "seed=0"], is_sweep=True)[0]
        'env=DoggoGoal1,DoggoGoal2,DoggoButton1,DoggoButton2,DoggoPush1,DoggoPush2'
    """
    name, others = take_word("slate", words)
    if name is None:
        return others
    if name not in SLATES:
        raise CommandLineError(
            f"Unknown slate '{name}'.{did_you_mean(name, SLATES)} Slates are: {', '.join(SLATES)}."
        )
    if len(SLATES[name]) > 1 and not is_sweep:
        raise CommandLineError(
            f"{name} is {len(SLATES[name])} environments: add -m to train on every one of them."
        )
    return [f"env={','.join(SLATES[name])}", *others]


def _with_launcher(words: list[str]) -> list[str]:
    """Overrides of a sweep with joblib's launcher, where it is installed and none is chosen."""
    try:
        has_joblib = find_spec("hydra_plugins.hydra_joblib_launcher") is not None
    except ModuleNotFoundError:
        has_joblib = False
    is_chosen = any(word.startswith("hydra/launcher=") for word in words)
    return [*words, "hydra/launcher=joblib"] if has_joblib and not is_chosen else words


def _ask_hydra(command: Command) -> int:
    """Let Hydra show something, or start the jobs of a sweep."""
    flags, words = command.flags, command.overrides
    with hydra_on_conf() as hydra:
        if flags.help:
            hydra.app_help("config", _parser(), flags)
        elif flags.hydra_help:
            hydra.hydra_help("config", _parser(), flags)
        elif flags.version:
            print(f"Hydra {version('hydra-core')}")
        elif flags.shell_completion:
            hydra.shell_completion("config", words)
        elif flags.cfg:
            hydra.show_cfg("config", words, flags.cfg, flags.package, flags.resolve)
        elif flags.info:
            hydra.show_info(flags.info, "config", words)
        else:
            with resolving(command.configs[0]):
                Path(command.configs[0].hydra.sweep.dir).mkdir(parents=True, exist_ok=True)
            hydra.multirun("config", job, ["hydra.mode=MULTIRUN", *words])
    return 0
