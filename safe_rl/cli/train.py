"""The command ``train.py``: its words, and what they make: a run, a sweep, or what Hydra shows.

What trains is imported when a run begins, so that help and refusals come at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

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

_SHORT = {
    **{"-m": "--multirun", "-r": "--run", "-h": "--help", "-sc": "--shell-completion"},
    **{"-cd": "--config-dir", "-cp": "--config-path", "-cn": "--config-name"},
    **{"-c": "--cfg", "-p": "--package", "-i": "--info"},
}
_VALUED = {"--config-dir", "--config-path", "--config-name", "--cfg", "--package"}
_QUESTIONS = {"--help", "--hydra-help", "--shell-completion", "--version"}
"""What Hydra answers without a configuration being checked."""
_SHOWN = {"--cfg", "--info"}
_FLAGS = {*_SHORT.values(), *_QUESTIONS, "--resolve"}


class Command(NamedTuple):
    """What a command line asks for.

    Attributes:
        flags: Flags by their long names, with their values.
        overrides: Overrides, with shorthands written out.
        run: Folder of the run that is continued, if one is.
        configs: What was composed and checked, with Hydra's own node for a new run: one, or of a
            sweep the jobs in which every value occurs; none of a question to Hydra.
    """

    flags: dict[str, list[str]]
    overrides: list[str]
    run: Path | None
    configs: list[DictConfig]

    @property
    def is_for_hydra(self) -> bool:
        """Whether it is a sweep, or something to be shown."""
        is_sweep = _is_sweep(self.flags, self.overrides)
        return is_sweep or bool((_QUESTIONS | _SHOWN) & self.flags.keys())


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
    flags, overrides = read_flags(words)
    if _QUESTIONS & flags.keys():
        return Command(flags, overrides, None, [])
    modules, overrides = split_imports(overrides)
    import_modules(modules or ())
    resume, overrides = _taken("resume", overrides)
    if resume is not None:
        _check_flags(flags)
        run = Path(resume).expanduser().absolute()
        return Command(flags, overrides, run, [compose_resumed(run, overrides, modules)])
    is_sweep = _is_sweep(flags, overrides)
    overrides = _with_folders(flags, expand_slate(overrides, is_sweep)) + note_imports(modules)
    is_shown = bool(_SHOWN & flags.keys())
    if is_sweep and not is_shown:
        overrides = _with_launcher(overrides)
    configs = compose_jobs(overrides, sweep=is_sweep, shown=is_shown, **_main_file(flags))
    return Command(flags, overrides, None, configs)


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
        if command.is_for_hydra:
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


def job(config: DictConfig) -> None:
    """One job of a sweep, in the process in which its launcher lets it run."""
    from safe_rl.cli.session import run_job

    run_job(config)


def read_flags(words: Sequence[str]) -> tuple[dict[str, list[str]], list[str]]:
    """Tell flags, which may stand anywhere, from overrides.

    Returns:
        Flags by their long names, with their values; and the overrides.

    Raises:
        CommandLineError: For a flag that there is not, is given twice, or lacks its value.

    Examples:
        >>> read_flags(["seed=0,1", "-m", "--config-dir", "mine", "algo=cpo"])
        ({'--multirun': [], '--config-dir': ['mine']}, ['seed=0,1', 'algo=cpo'])
    """
    flags: dict[str, list[str]] = {}
    overrides: list[str] = []
    last = ""
    for word in words:
        if word.startswith("-"):
            name, equals, value = word.partition("=")
            last = _SHORT.get(name, name)
            if last not in _FLAGS:
                raise CommandLineError(_without_dashes(word))
            if last in flags and last != "--config-dir":
                raise CommandLineError(f"'{last}' is given more than once.")
            flags.setdefault(last, []).extend([value] if equals else [])
            last = "" if equals else last
        elif last in _VALUED or (last == "--info" and "=" not in word):
            flags[last].append(word)
            last = ""
        else:
            overrides.append(word)
            last = ""
    for name in _VALUED & flags.keys():
        if not flags[name]:
            raise CommandLineError(f"'{name}' takes a value: {name}=…")
    for name in {"--package", "--resolve"} & flags.keys():
        if not {"--cfg", "--help"} & flags.keys():
            raise CommandLineError(f"'{name}' says how a configuration is shown: add --cfg job.")
    return flags, overrides


def _without_dashes(flag: str) -> str:
    """What to write instead of a flag that there is not."""
    name, _, value = flag.lstrip("-").partition("=")
    written = f"{name.replace('-', '_')}={value or '…'}"
    return (
        f"'{flag}': there is no such flag. A key is written without dashes, {written}; "
        "'python train.py --hydra-help' names the flags."
    )


def _check_flags(flags: Mapping[str, Sequence[str]]) -> None:
    """Refuse flags beside ``resume=``; folders of configurations are not needed again."""
    if "--multirun" in flags:
        raise CommandLineError(
            "resume= continues one run. To continue a sweep, start it again as it was: finished "
            "runs are skipped, interrupted ones continue."
        )
    for flag in flags.keys() - {"--config-dir", "--run"}:
        raise CommandLineError(
            f"'{flag}' does not go with resume=: a run has its configuration in config.yaml."
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


def _with_folders(flags: Mapping[str, Sequence[str]], words: Sequence[str]) -> list[str]:
    """Overrides with the folders of ``--config-dir`` among those that Hydra searches."""
    folders = [Path(folder).expanduser().absolute() for folder in flags.get("--config-dir", ())]
    for given, folder in zip(flags.get("--config-dir", ()), folders, strict=True):
        if not folder.is_dir():
            raise CommandLineError(f"--config-dir {given}: there is no such folder.")
    if not folders:
        return list(words)
    paths = [f"file://{folder}" for folder in folders]
    value, others = _taken("hydra.searchpath", words)
    if value is not None:
        paths += cast(list[str], parse(f"hydra.searchpath={value}").value())
    return [*others, *overrides_of({"hydra.searchpath": paths})]


def _main_file(flags: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    (folder,) = flags.get("--config-path", [CONF])
    (name,) = flags.get("--config-name", ["config"])
    return {"folder": Path(folder).absolute(), "name": name}


def _with_launcher(words: Sequence[str]) -> list[str]:
    """Overrides of a sweep with joblib's launcher, where it is installed and none is chosen."""
    is_chosen = any(word.startswith("hydra/launcher=") for word in words)
    try:
        has_joblib = find_spec("hydra_plugins.hydra_joblib_launcher") is not None
    except ModuleNotFoundError:
        has_joblib = False
    return [*words, *(["hydra/launcher=joblib"] if has_joblib and not is_chosen else [])]


def _is_sweep(flags: Mapping[str, Sequence[str]], overrides: Sequence[str]) -> bool:
    return "--multirun" in flags or "hydra.mode=MULTIRUN" in overrides


def _ask_hydra(command: Command) -> int:
    """Let `hydra.main` show something, or start the jobs of a sweep.

    It takes its words from the process.
    """
    flags, words = command.flags, command.overrides
    place = _main_file(flags)
    if not (_QUESTIONS | _SHOWN) & flags.keys():
        from safe_rl.cli.session import check_writable

        with resolving(command.configs[0]):
            check_writable(Path(command.configs[0].hydra.sweep.dir), "hydra.sweep.dir")
    # overrides hold the folders of what was composed
    known = {"--config-path", "--config-name", *(["--config-dir"] if command.configs else [])}
    given = [f"{k}={v[0]}" if v else k for k, v in flags.items() if k not in known]
    main = hydra.main(
        version_base="1.3", config_path=str(place["folder"]), config_name=place["name"]
    )
    before, sys.argv = sys.argv, [sys.argv[0], *given, *words]
    try:
        main(job)()
    finally:
        sys.argv = before
    return 0
