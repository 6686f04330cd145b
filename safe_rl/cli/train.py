"""The command ``train.py``: its words, and what they make: a run, a sweep, or what Hydra shows.

What trains is imported when a run begins, so that help and refusals come at once.
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, cast

import hydra
from hydra.core.utils import configure_log
from omegaconf import DictConfig, open_dict

from safe_rl.cli import say_interruptions
from safe_rl.cli.composing import CONF, compose_jobs, hydras_own, resolving
from safe_rl.cli.grammar import CommandLineError, overrides_of, parse
from safe_rl.cli.resuming import compose_resumed
from safe_rl.cli.user_code import import_modules, note_imports, split_imports
from safe_rl.envs import store_configs
from safe_rl.naming import did_you_mean
from safe_rl.scores.benchmark import SLATES

__all__ = ["Command", "expand_slate", "job", "main", "read_command", "read_flags"]

if TYPE_CHECKING:
    from safe_rl.cli.session import Session

store_configs()

_SWITCHES = {
    **{"help": "-h", "hydra_help": "", "version": "", "shell_completion": "-sc"},
    **{"multirun": "-m", "run": "-r", "resolve": ""},
}
_VALUED = {"config_path": "-cp", "config_name": "-cn", "cfg": "-c", "package": "-p", "info": "-i"}
_QUESTIONS = ("help", "hydra_help", "version", "shell_completion")
"""What Hydra answers without a configuration being checked."""
_SHOWN = ("cfg", "info")


class Command(NamedTuple):
    """What a command line asks for.

    Attributes:
        flags: Flags by their long names, with underscores, as far as they are given.
        overrides: Overrides, with shorthands written out.
        run: Folder of the run that is continued, if one is.
        configs: What was composed and checked, with Hydra's own node for a new run: one, or of a
            sweep the jobs in which every value occurs; none of a question to Hydra.
    """

    flags: dict[str, Any]
    overrides: list[str]
    run: Path | None = None
    configs: Sequence[DictConfig] = ()

    @property
    def is_question(self) -> bool:
        """Whether Hydra answers it, without a configuration being checked."""
        return any(flag in self.flags for flag in _QUESTIONS)

    @property
    def is_shown(self) -> bool:
        """Whether a configuration is shown."""
        return any(flag in self.flags for flag in _SHOWN)

    @property
    def is_sweep(self) -> bool:
        """Whether its overrides may have several values each."""
        return "multirun" in self.flags or "hydra.mode=MULTIRUN" in self.overrides

    @property
    def place(self) -> dict[str, Any]:
        """Folder and name of the main configuration."""
        folder = Path(self.flags.get("config_path", CONF)).absolute()
        return {"folder": folder, "name": self.flags.get("config_name", "config")}


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
    command = Command(*read_flags(words))
    if command.is_question:
        return command
    modules, overrides = split_imports(command.overrides)
    import_modules(modules or ())
    resume, overrides = _taken("resume", overrides)
    if resume is not None:
        _check_flags(command)
        run = Path(resume).expanduser().absolute()
        return Command(command.flags, overrides, run, [compose_resumed(run, overrides, modules)])
    overrides = _with_folders(command, expand_slate(overrides, command.is_sweep))
    overrides += note_imports(modules)
    if command.is_sweep and not command.is_shown:
        overrides = _with_launcher(overrides)
    configs = compose_jobs(
        overrides, sweep=command.is_sweep, shown=command.is_shown, **command.place
    )
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
        is_expected = isinstance(error, ValueError) if session is None else session.refuses(error)
        if not is_expected or os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        return " ".join(str(error).split())
    return 0 if session.interrupted_by is None else 128 + session.interrupted_by


def _session(command: Command, program: str) -> Session:
    from safe_rl.cli.session import Session, new_folder

    (config,) = command.configs
    if command.run is not None:
        own = hydras_own([word for word in command.overrides if word.startswith("hydra.")])
        session = Session(config, command.run, continues=True, program=program)
    else:
        with resolving(config):
            folder, missing = new_folder(config.hydra)
        with open_dict(config):
            own = config.pop("hydra")
        session = Session(config, folder, own, missing=missing, program=program)
    configure_log(own.job_logging, own.verbose)
    return session


def job(config: DictConfig) -> float:
    """One job of a sweep, in the process in which its launcher lets it run."""
    from safe_rl.cli.session import run_job

    return run_job(config)


class _Parser(ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise CommandLineError(f"{message[:1].upper()}{message[1:]}.")


def read_flags(words: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Tell flags, which may stand anywhere, from overrides.

    Raises:
        CommandLineError: For a flag that there is not, or that lacks its value.

    Examples:
        >>> read_flags(["seed=0,1", "-m", "--config-dir", "mine", "algo=cpo"])
        ({'config_dir': ['mine'], 'multirun': True}, ['seed=0,1', 'algo=cpo'])
    """
    parser = _Parser(add_help=False, allow_abbrev=False)
    parser.add_argument("-cd", "--config-dir", action="append")
    for name, short in _SWITCHES.items():
        parser.add_argument(*filter(None, (short, _flag(name))), action="store_true", default=None)
    for name, short in _VALUED.items():
        more: Any = {"nargs": "?", "const": "all"} if name == "info" else {}
        parser.add_argument(short, _flag(name), **more)
    given, overrides = parser.parse_known_args(words)
    for word in overrides:
        if word.startswith("-"):
            name, _, value = word.lstrip("-").partition("=")
            raise CommandLineError(
                f"'{word}': there is no such flag. A key is written without dashes, "
                f"{name.replace('-', '_')}={value or '…'}; 'python train.py --hydra-help' names "
                "the flags."
            )
    return {name: value for name, value in vars(given).items() if value is not None}, overrides


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _check_flags(command: Command) -> None:
    """Refuse flags beside ``resume=``; folders of configurations are not needed again."""
    if command.is_sweep:
        raise CommandLineError(
            "resume= continues one run. To continue a sweep, start it again as it was: finished "
            "runs are skipped, interrupted ones continue."
        )
    for name in command.flags.keys() - {"config_dir", "run"}:
        raise CommandLineError(
            f"'{_flag(name)}' does not go with resume=: a run has its configuration in config.yaml."
        )


def _taken(name: str, words: Sequence[str]) -> tuple[str | None, list[str]]:
    """The value of a word that is no override, None if it is not given; and the other words."""
    given = [word for word in words if word.lstrip("+").startswith(f"{name}=")]
    if len(given) > 1:
        raise CommandLineError(f"'{name}' is given more than once: {', '.join(given)}.")
    others = [word for word in words if word not in given]
    return given[0].partition("=")[2] if given else None, others


def expand_slate(words: Sequence[str], is_sweep: bool) -> list[str]:
    """Write ``slate=SG6`` out as the slate's environments (Ray, Achiam, Amodei 2019, section 5.1).

    Raises:
        CommandLineError: If there is no such slate, or the command cannot have it.

    Examples:
        >>> expand_slate(["slate=SGDoggo", "seed=0"], is_sweep=True)[0]
        'env=DoggoGoal1,DoggoGoal2,DoggoButton1,DoggoButton2,DoggoPush1,DoggoPush2'
    """
    name, others = _taken("slate", words)
    if name is None:
        return others
    if name not in SLATES:
        raise CommandLineError(
            f"Unknown slate '{name}'.{did_you_mean(name, SLATES)} Slates are: {', '.join(SLATES)}."
        )
    if any(word.startswith("env=") for word in others):
        raise CommandLineError("slate= and env= both name environments: use one of them.")
    if len(SLATES[name]) > 1 and not is_sweep:
        raise CommandLineError(
            f"{name} is {len(SLATES[name])} environments: add -m to train on every one of them."
        )
    return [f"env={','.join(SLATES[name])}", *others]


def _with_folders(command: Command, words: list[str]) -> list[str]:
    """Overrides with the folders of ``--config-dir`` among those that Hydra searches."""
    folders = [
        Path(folder).expanduser().absolute() for folder in command.flags.get("config_dir", ())
    ]
    if missing := next((folder for folder in folders if not folder.is_dir()), None):
        raise CommandLineError(f"--config-dir {missing}: there is no such folder.")
    if not folders:
        return words
    paths = [f"file://{folder}" for folder in folders]
    value, others = _taken("hydra.searchpath", words)
    if value is not None:
        paths += cast(list[str], parse(f"hydra.searchpath={value}").value())
    return [*others, *overrides_of({"hydra.searchpath": paths})]


def _with_launcher(words: list[str]) -> list[str]:
    """Overrides of a sweep with joblib's launcher, where it is installed and none is chosen."""
    try:
        has_joblib = find_spec("hydra_plugins.hydra_joblib_launcher") is not None
    except ModuleNotFoundError:
        has_joblib = False
    is_chosen = any(word.startswith("hydra/launcher=") for word in words)
    return [*words, "hydra/launcher=joblib"] if has_joblib and not is_chosen else words


def _ask_hydra(command: Command) -> int:
    """Let `hydra.main` show something, or start the jobs of a sweep.

    It takes its words from the process.
    """
    if not (command.is_question or command.is_shown):
        from safe_rl.cli.session import check_writable

        with resolving(command.configs[0]):
            check_writable(Path(command.configs[0].hydra.sweep.dir), "hydra.sweep.dir")
    # overrides hold the folders of what was composed
    flags = {k: v for k, v in command.flags.items() if k not in ("config_path", "config_name")}
    folders = flags.pop("config_dir", [])
    if folders and not command.configs:
        flags["config_dir"] = folders[0]
    given = [_flag(k) if v is True else f"{_flag(k)}={v}" for k, v in flags.items()]
    folder, name = command.place.values()
    main = hydra.main(version_base="1.3", config_path=str(folder), config_name=name)
    before, sys.argv = sys.argv, [sys.argv[0], *given, *command.overrides]
    try:
        main(job)()
    finally:
        sys.argv = before
    return 0
