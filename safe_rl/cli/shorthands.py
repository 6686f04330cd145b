"""Shorthands of ``train.py`` that Hydra does not know: ``resume=`` and ``slate=``.

They are written out before Hydra sees the command line.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.keys import KEYS
from safe_rl.cli.meant import keys_meant, paths_of
from safe_rl.cli.overrides import CommandLineError
from safe_rl.cli.user_code import KEY, check_imports
from safe_rl.naming import did_you_mean
from safe_rl.runs.files import read_config
from safe_rl.runs.folder import RunFolder
from safe_rl.runs.identity import role_of
from safe_rl.scores.slates import SLATES

__all__ = ["expand_arguments"]

# of Hydra, that would make it read another configuration than the run's
_OTHER_CONFIGURATIONS = ("--config-path", "-cp", "--config-name", "-cn")
_FLAGS_WITH_VALUE = (
    *(*_OTHER_CONFIGURATIONS, "--config-dir", "-cd", "--package", "-p", "--cfg", "-c"),
    "--experimental-rerun",
)
_INFO = ("--info", "-i")  # whose value may lack
_JOBLIB = "hydra_plugins.hydra_joblib_launcher"


def expand_arguments(arguments: Sequence[str]) -> list[str]:
    """Write the shorthands out.

    ``resume=RUN_DIR`` becomes what makes Hydra read the run's own configuration and write into its
    folder; ``slate=SG6`` becomes the slate's environments (Ray, Achiam, Amodei 2019, section 5.1).
    A sweep gets the launcher that runs its jobs in processes of their own, if that is installed.

    Args:
        arguments: Arguments of ``train.py``.

    Raises:
        CommandLineError: If a shorthand cannot be written out.

    Examples:
        >>> expand_arguments(["-m", "slate=SGDoggo", "seed=0"])[1]
        'env=DoggoGoal1,DoggoGoal2,DoggoButton1,DoggoButton2,DoggoPush1,DoggoPush2'
    """
    expanded = _flags_first(arguments)
    _refuse_other_folders(expanded)
    for name, expand in _SHORTHANDS.items():
        given = [a for a in expanded if a.lstrip("+").startswith(f"{name}=")]
        if len(given) > 1:
            raise CommandLineError(f"'{name}' is given more than once: {', '.join(given)}.")
        if given:
            others = [argument for argument in expanded if argument != given[0]]
            expanded = expand(given[0].partition("=")[2], others)
    return _with_launcher(expanded)


def _flags_first(arguments: Sequence[str]) -> list[str]:
    """Flags, each in one word with its value, and then overrides: Hydra wants these in one piece.

    Examples:
        >>> _flags_first(["seed=0,1", "-m", "--config-dir", "mine", "algo=cpo"])
        ['-m', '--config-dir=mine', 'seed=0,1', 'algo=cpo']
        >>> _flags_first(["algo=cpo", "--info", "--cfg", "job"])
        ['--info', '--cfg=job', 'algo=cpo']
    """
    flags: list[str] = []
    overrides: list[str] = []
    last = ""
    for word in arguments:
        if word.startswith("-"):
            flags.append(word)
        elif last in _FLAGS_WITH_VALUE or (last in _INFO and "=" not in word):
            flags[-1] = f"{last}={word}"
        else:
            overrides.append(word)
        last = word
    return [*flags, *overrides]


def _refuse_other_folders(arguments: Sequence[str]) -> None:
    """Hydra takes the last of several folders, and says nothing of the others."""
    given = [a.partition("=")[2] for a in arguments if a.startswith(("--config-dir=", "-cd="))]
    if len(given) > 1:
        others = ",".join(f"file://{Path(folder).absolute()}" for folder in given[1:])
        raise CommandLineError(
            f"--config-dir is given more than once: {', '.join(given)}. Leave the first, and add "
            f"'hydra.searchpath=[{others}]'."
        )


def _with_launcher(arguments: list[str]) -> list[str]:
    """Sweeps run on joblib where it is installed, unless told otherwise."""
    is_told = any(argument.startswith("hydra/launcher=") for argument in arguments)
    if not _is_sweep(arguments) or is_told or not _is_installed(_JOBLIB):
        return arguments
    return [*arguments, "hydra/launcher=joblib"]


def _expand_resume(value: str, others: list[str]) -> list[str]:
    directory = Path(value).expanduser().absolute()
    if _is_sweep(others):
        raise CommandLineError(
            "resume= continues one run. To continue a sweep, start it again as it was: finished "
            "runs are skipped, interrupted ones go on."
        )
    run = RunFolder(directory)
    try:
        run.check_is_run()
        config = OmegaConf.create(read_config(run.config))
    except (OSError, ValueError) as error:
        raise CommandLineError(f"resume={value}: {error}") from None
    _refuse_hydras_own(config, run, others)
    _refuse_foreign_cluster(config, others, run.config)
    imports = [argument for argument in others if argument.lstrip("+").startswith(f"{KEY}=")]
    check_imports(config, imports or None, Path(value))
    for argument in others:
        key = argument.lstrip("+~").partition("=")[0]
        is_flag = key.startswith("-")
        stays = not (is_flag or role_of(key.replace("/", ".")).may_change)
        section = key.partition(".")[0].partition("/")[0]
        is_plain = argument.startswith(section) and not is_flag
        if is_plain and section not in (*config, *KEYS, "hydra", ""):
            meant = keys_meant(key, list(paths_of(config)))
            hint = f" Did you mean {' or '.join(map(repr, meant))}?" if meant else ""
            raise CommandLineError(f"'{argument}': the run has no '{key}'.{hint}")
        if stays or key in _OTHER_CONFIGURATIONS or isinstance(config.get(key), DictConfig):
            raise CommandLineError(
                f"'{argument}' cannot change in a run that is continued. What can: its length "
                "(frames=…), what belongs to the machine (checkpoint.interval=…), and numbers "
                "below loss, limits, policy_update and the like, except those that a checkpoint "
                "brings along, such as an optimiser's lr. For a new run from trained networks use "
                f"init_from={value}."
            )
    folder = str(directory).replace("'", "\\'")
    return [
        *("--config-path", str(directory), "--config-name", "config"),
        f"hydra.run.dir='{folder}'",
        "hydra.output_subdir=null",
        "hydra/job_logging=stdout",
        *others,
    ]


def _refuse_hydras_own(config: DictConfig, run: RunFolder, others: list[str]) -> None:
    """Runs write settings only; what else Hydra reads in a folder can name code to run."""
    keys = [key for key in ("hydra", "defaults") if key in config]
    found = keys if "@package" not in run.config.read_text() else [*keys, "@package"]
    if found:
        raise CommandLineError(
            f"{run.config} holds '{found[0]}', which runs never write and which could "
            "make code run: delete it there to resume."
        )
    # it looks for files of its own, and of what is overridden, beside the configuration
    groups = ("hydra", *(re.split("[=@]", argument.lstrip("+~"))[0] for argument in others))
    for group in groups:
        if group and (run.directory / group).is_dir():
            raise CommandLineError(
                f"{run.directory / group} is a folder that runs never write. Hydra would read "
                "settings there, which could make code run: delete it to resume."
            )


def _refuse_foreign_cluster(config: DictConfig, others: list[str], path: Path) -> None:
    """What Ray is started with can make code run: only the command line says it, not a file."""
    stored = dict(OmegaConf.select(config, "collector.ray_init") or {})
    if stored.pop("address", None) is not None and not any(
        argument.startswith("collector.ray_init.address=") for argument in others
    ):
        raise CommandLineError(
            f"{path} names a Ray cluster, which is not taken from a file: say again "
            "collector.ray_init.address=… (null for Ray on this machine)."
        )
    if "runtime_env" in (OmegaConf.select(config, "collector.resources") or {}):
        stored["runtime_env"] = None  # actors can be started with it, too
    if stored:
        raise CommandLineError(
            f"{path} starts Ray with {', '.join(stored)}, which could make code run: delete that "
            "there to resume."
        )


def _expand_slate(value: str, others: list[str]) -> list[str]:
    if value not in SLATES:
        raise CommandLineError(
            f"Unknown slate '{value}'.{did_you_mean(value, SLATES)} Slates are: "
            f"{', '.join(SLATES)}."
        )
    if any(argument.startswith("env=") for argument in others):
        raise CommandLineError("slate= and env= both name environments: use one of them.")
    environments = SLATES[value]
    if len(environments) > 1 and not _is_sweep(others):
        raise CommandLineError(
            f"{value} is {len(environments)} environments: add -m to train on every one of them."
        )
    return _flags_first([f"env={','.join(environments)}", *others])


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False


def _is_sweep(arguments: list[str]) -> bool:
    return any(argument in ("-m", "--multirun") for argument in arguments)


_SHORTHANDS: dict[str, Callable[[str, list[str]], list[str]]] = {
    "resume": _expand_resume,
    "slate": _expand_slate,
}
