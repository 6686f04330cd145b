"""The command ``train.py``: it reads its arguments and starts a run, a sweep or Hydra's output.

The modules of training are imported when a run begins, so that help and errors appear at once.
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig

from safe_rl.cli.composing import (
    compose_jobs,
    compose_resumed,
    hydra_on_conf,
    resolving,
    search_folders,
)
from safe_rl.cli.grammar import CommandLineError, parse, say_interruptions, split_imports, take_word
from safe_rl.cli.user_code import import_modules, note_imports
from safe_rl.naming import did_you_mean
from safe_rl.scores.benchmark import SLATES

_FLAGS: dict[str, tuple[str, dict[str, Any]]] = {
    "--help -h": ("show environments, algorithms and all settings", {}),
    "--hydra-help": ("show these flags and Hydra's settings", {}),
    "--shell-completion -sc": ("tab completion: -sc install=bash", {}),
    "--multirun -m": ("a sweep: a run for every combination of values", {}),
    "--config-dir -cd": ("folder with your YAML files; may be repeated", {"action": "append"}),
    "--cfg -c": ("show the configuration", {"choices": ("job", "hydra", "all")}),
    "--package -p": ("with --cfg: show only this part", {"action": "store"}),
    "--resolve": ("with --cfg: show values, not references", {}),
}
"""Flag and its short form -> its help, and arguments of argparse if it is not a switch."""


class Command(NamedTuple):
    """A command line that has been read.

    Attributes:
        flags: Flags by their long names, with underscores.
        overrides: Overrides; shorthands such as ``slate=`` are written out.
        configs: The checked configurations, those of new runs with the node ``hydra``: one, or for
            a sweep jobs in which every value occurs; none for ``--help`` and the like.
        run: Folder of the run that is continued, if any.
        is_run: Whether it is one run, new or continued. Otherwise Hydra prints something, or starts
            a sweep.
    """

    flags: Namespace
    overrides: list[str]
    configs: Sequence[DictConfig] = ()
    run: Path | None = None
    is_run: bool = False


def read_command(words: Sequence[str]) -> Command:
    """Read a command line; compose and check its configurations before anything is written.

    Raises:
        CommandLineError: If an argument cannot be used; the message says what to write instead.
        ValueError: If a run, a part or an environment cannot have a value.

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
    if flags.help or flags.hydra_help or flags.shell_completion:
        return Command(flags, flags.overrides)
    is_sweep = flags.multirun or "hydra.mode=MULTIRUN" in flags.overrides
    modules, overrides = split_imports(flags.overrides)
    import_modules(modules)
    resume, overrides = take_word("resume", overrides)
    if resume:
        if is_sweep or flags.cfg:
            raise CommandLineError(
                "resume= continues one run, which has its configuration in config.yaml: no flag "
                "goes with it. To continue a sweep, start it again as it was: finished runs are "
                "skipped, interrupted ones continue."
            )
        run = Path(resume[-1]).expanduser().absolute()
        return Command(flags, overrides, [compose_resumed(run, overrides, modules)], run, True)
    overrides = expand_slate(overrides, is_sweep)
    overrides = [*search_folders(flags.config_dir or ()), *overrides, *note_imports(modules)]
    if is_sweep and not flags.cfg:
        overrides = _with_launcher(overrides)
    configs = compose_jobs(overrides, sweep=is_sweep, shown=bool(flags.cfg))
    return Command(flags, overrides, configs, is_run=not (is_sweep or flags.cfg))


def main(arguments: Sequence[str] | None = None, program: str = "python train.py") -> int | str:
    """Run the command; return its exit status, or the error message with which it ends.

    Raises:
        SystemExit: If a signal has ended the run.
    """
    say_interruptions()
    session = None
    try:
        command = read_command(sys.argv[1:] if arguments is None else arguments)
        if not command.is_run:
            return _ask_hydra(command)
        from safe_rl.cli.session import Session

        (config,) = command.configs
        run = command.run
        session = Session(config, run, continues=run is not None, program=program)
        session.run()
    except Exception as error:
        is_about_words = isinstance(error, ValueError | HydraException | OSError)
        is_expected = is_about_words if session is None else session.refuses(error)
        if not is_expected or os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        return " ".join(str(error).split())
    return 0


class _Parser(ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise CommandLineError(f"{message[:1].upper()}{message[1:]}.")


def _parser() -> ArgumentParser:
    """A parser of flags and overrides, in any order."""
    parser = _Parser(add_help=False, allow_abbrev=False)
    for names, (meaning, kind) in _FLAGS.items():
        parser.add_argument(*names.split(), help=meaning, **kind or {"action": "store_true"})
    parser.add_argument("overrides", nargs="*", help="settings, key=value")
    return parser


def expand_slate(words: Sequence[str], is_sweep: bool) -> list[str]:
    """Replace ``slate=SG6`` by the slate's environments (Ray, Achiam, Amodei 2019, section 5.1)."""
    given, others = take_word("slate", words)
    if not given:
        return others
    name = given[-1]
    if any(word.startswith("env=") for word in others):
        raise CommandLineError(f"slate={name} chooses the environments: leave out env=….")
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
    """A sweep's overrides with joblib's launcher, if it is installed and none is chosen."""
    with suppress(ModuleNotFoundError):  # if Hydra has no plugin at all
        is_chosen = any(word.startswith("hydra/launcher=") for word in words)
        if not is_chosen and find_spec("hydra_plugins.hydra_joblib_launcher"):
            return [*words, "hydra/launcher=joblib"]
    return words


def _ask_hydra(command: Command) -> int:
    """Let Hydra print what a flag asks for, or start a sweep; return the exit status."""
    flags, words = command.flags, command.overrides
    with hydra_on_conf() as hydra:
        if flags.help:
            hydra.app_help("config", _parser(), flags)
        elif flags.hydra_help:
            hydra.hydra_help("config", _parser(), flags)
        elif flags.shell_completion:
            hydra.shell_completion("config", words)
        elif flags.cfg:
            hydra.show_cfg("config", words, flags.cfg, flags.package, flags.resolve)
        else:
            from safe_rl.cli.sweeps import Sweep

            first = command.configs[0]
            with resolving(first):
                sweep = Sweep(first.hydra, words)
            try:
                # Hydra's own plan lacks the keys that only swept choices, such as of algo=, have
                given = first.hydra.overrides
                job = ["hydra.mode=MULTIRUN", *given.hydra, *given.task]
                plan = hydra.compose_config("config", job, RunMode.MULTIRUN, True)
                plan.hydra.overrides.task = [w for w in words if not parse(w).is_hydra_override()]
                hydra.compose_config = lambda **_: plan
                hydra.multirun("config", sweep, [])
            finally:
                are_finished = sweep.print_summary()
            return 0 if are_finished else 1
    return 0
