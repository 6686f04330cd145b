"""What ``train.py`` does around Hydra: words of our own before it, a run after it.

Hydra itself reads the command line, composes the configuration, and starts sweeps. The modules of
training are imported when a run begins, so that help and errors appear at once.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from safe_rl.checks import UNEXPECTED
from safe_rl.cli.composing import (
    COMPOSITION_ERRORS,
    RESUMED,
    explain,
    overrides_of,
    read_resumed,
    refuse_changes,
)
from safe_rl.cli.config import check_settings
from safe_rl.cli.folders import name_choices
from safe_rl.cli.options import end_by_interrupt, keep_streams, split_imports, take_word
from safe_rl.cli.sweeps import run_in_sweep
from safe_rl.envs import store_configs
from safe_rl.files import CONF, printable
from safe_rl.naming import did_you_mean
from safe_rl.trust import import_modules


def start(main: Callable[[], Any], words: Sequence[str] | None = None) -> None:
    """Run a function of ``@hydra.main``, with ``import=``, ``slate=`` and ``resume=``.

    The words are the command's arguments; None: those of the process. If they cannot be used, the
    process ends with a message of one line.
    """
    keep_streams()
    argv, full_error = sys.argv, os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its errors, and does not print them
    try:
        sys.argv = [sys.argv[0], *prepare(sys.argv[1:] if words is None else words)]
        main()
    except (*COMPOSITION_ERRORS, OSError) as error:
        # the user wants to see the traceback, or has to
        if full_error == "1" or UNEXPECTED in getattr(error, "__notes__", ()):
            raise
        sys.exit(printable(explain(error, sys.argv[1:])))
    except SystemExit as end:
        if full_error == "1" and end.__cause__ is not None:  # `job` has made a line of it
            raise end.__cause__ from end.__cause__.__cause__
        raise
    except KeyboardInterrupt:
        end_by_interrupt()
    finally:
        sys.argv = argv
        os.environ.pop("HYDRA_FULL_ERROR")
        if full_error is not None:
            os.environ["HYDRA_FULL_ERROR"] = full_error


def prepare(words: Sequence[str]) -> list[str]:
    """Turn a command's words into words for Hydra.

    ``import=my_module`` is imported; ``slate=SG6`` becomes the slate's environments (Ray, Achiam,
    Amodei 2019, section 5.1); for ``resume=RUN`` the run's own configuration takes the place of
    ``conf/config.yaml``. A ValueError says what cannot be used.

    Examples:
        >>> prepare(["-m", "slate=SGPoint", "seed=0"])
        ['env=PointGoal1,PointGoal2,PointButton1,PointButton2,PointPush1,PointPush2', 'seed=0', '-m']
    """  # noqa: E501
    # To list its groups for a help, Hydra copies the store a hundred times: ten seconds with all
    # environments, whose names are in the help's header. But a file of the user's may build on any.
    has_files = any(word.startswith(("-c", "--config-", "hydra.searchpath=")) for word in words)
    shown = [word.removeprefix("env=") for word in words if word.startswith("env=")]
    is_help = bool({"--help", "-h"} & {*words}) and not has_files
    store_configs((shown or ["PointGoal1"]) if is_help else None)
    modules, words = split_imports(words)
    import_modules(modules)
    runs, words = take_word("resume", words)
    slates, words = take_word("slate", words)
    for word in words:
        if re.match(r"hydra\.(launcher|sweeper)=\w", word):
            raise ValueError(f"{word}: it is chosen with a slash, {word.replace('.', '/', 1)}.")
    # Hydra's parser of flags takes overrides only where they stand together
    pairs = list(pairwise(["", *words]))
    flags = [word for before, word in pairs if _is_of_flags(before, word)]
    words = [word for before, word in pairs if not _is_of_flags(before, word)]
    others = [word for word in words if word.startswith("env=")]
    if slates and (runs or others or len(slates) > 1):
        raise ValueError(
            f"slate={slates[0]} chooses the environments: leave out resume=, env= and other slates."
        )
    if runs:
        directory = Path(runs[-1]).expanduser().absolute()
        ConfigStore.instance().store(RESUMED, read_resumed(directory, modules, [*words, *flags]))
        return [*words, *flags, f"--config-name={RESUMED}"]
    new = [] if modules is None else [*overrides_of({"import": modules})]
    if slates:
        from safe_rl.scores.benchmark import SLATES  # reads the published scores
    for name in slates:
        if name not in SLATES:
            raise ValueError(
                f"Unknown slate '{name}'.{did_you_mean(name, SLATES)} "
                f"Slates are: {', '.join(SLATES)}."
            )
        new.append(f"env={','.join(SLATES[name])}")
    return [*new, *words, *flags]


def _is_of_flags(before: str, word: str) -> bool:
    """Whether a word is a flag of Hydra, or the value of the one before it."""
    takes_any = re.fullmatch("-c[dnp]|--config-(dir|name|path)", before)
    takes_plain = re.fullmatch("-[cip]|--(cfg|info|package|experimental-rerun)", before)
    return word.startswith("-") or bool(takes_any or (takes_plain and "=" not in word))


def job(config: DictConfig) -> float | None:
    """Begin or continue the run of a configuration that Hydra has composed.

    In a sweep the value is that of `run_in_sweep`. The process ends if a signal ends the run, or
    with a message of one line if it cannot go on.
    """
    settings = HydraConfig.get()
    directory = Path(settings.runtime.output_dir)
    if settings.mode == RunMode.MULTIRUN:
        return run_in_sweep(config, settings, directory)
    if not settings.run.dir:
        sys.exit("hydra.run.dir= is empty: it names the folder of the run.")
    is_resumed = settings.job.config_name == RESUMED
    try:
        if is_resumed:
            refuse_changes(directory, config)
        name_choices(config, settings)
        check_settings(config)
    except (OmegaConfBaseException, ValueError) as error:
        with suppress(OSError):
            directory.rmdir()  # Hydra has made it; a folder with files stays
        raise SystemExit(printable(explain(error, sys.argv[1:]))) from error
    from safe_rl.training.train import is_expected, train  # torch: help and errors do not need it

    try:
        train(config, directory, hydra=None if is_resumed else settings, continues=is_resumed)
    except Exception as error:
        if not is_expected(error):
            raise
        raise SystemExit(printable(" ".join(str(error).split()))) from error
    return None


@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
def _main(config: DictConfig) -> float | None:
    return job(config)


def main(words: Sequence[str] | None = None) -> int:
    """Train, as ``python train.py`` does: the command ``safe-rl train``."""
    start(_main, words)
    return 0
