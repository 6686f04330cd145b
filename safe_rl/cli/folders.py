"""Names of runs and of their folders: what was chosen, and resolvers for ``conf/config.yaml``."""

from __future__ import annotations

import re
from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from safe_rl.envs.families import env_names
from safe_rl.files import CONF
from safe_rl.runs.identity import Role, role_of


def env_name(name: str, chosen: str, sources: Iterable[Any] = ()) -> str:
    """Name of an environment whose configuration has the name `name` and was chosen as `chosen`.

    A file of the user's that builds on another environment, of the package or of another file in
    one of Hydra's sources, is not that environment.

    Examples:
        >>> env_name("PointGoal1", "my_level"), env_name("Dense", "my_level")
        ('my_level', 'Dense')
    """
    files = (Path(s.path, "env", f"{name}.yaml") for s in sources if s.schema == "file")
    is_taken = name in env_names() or any(file.is_file() for file in files)
    is_of_another = is_taken and chosen not in env_names()
    return chosen if is_of_another else name


def job_name(words: Iterable[str]) -> str:
    """The name of one folder for the overrides of a job in a sweep.

    It lacks those that are in the folder's path or belong to the machine, and has no slashes; of
    one over 255 bytes it is the beginning and a hash.

    Examples:
        >>> job_name(["seed=3", "init_from=../a", "device=cuda", "frames=3e5"])
        'frames=3e5,init_from=.._a'
        >>> job_name(["note=" + "a" * 300]) == "note=" + "a" * 195 + "-4c775031"
        True
    """
    keys = {word: word.lstrip("+~").partition("=")[0] for word in words}
    in_path = ("env", "algo", "seed")
    named = [w for w, k in keys.items() if k not in in_path and role_of(k) is not Role.MACHINE]
    name = ",".join(sorted(named)).replace("/", "_")
    if len(name.encode()) <= 255:
        return name
    beginning = name.encode()[:200].decode(errors="ignore")
    return f"{beginning}-{sha256(name.encode()).hexdigest()[:8]}"


def name_choices(config: DictConfig, hydra: Any) -> None:
    """Give a run the names of what was chosen: whatever was merged into it, the name is true.

    Raises:
        ValueError: If a transform is chosen twice, or a changed environment has the name of another
            one of the package.
    """
    choices, transforms = hydra.runtime.choices, config.get("transforms") or ()
    for word in hydra.overrides.task:
        names = re.findall(r"[^][,\s]+", word.removeprefix("transforms="))
        if word.startswith("transforms=[") and len(set(names)) < len(names):
            raise ValueError(f"{word}: a transform is there twice, and would be applied once.")
    chosen_files = [*choices.items(), *(("transforms", name) for name in transforms)]
    _refuse_hidden_files(chosen_files, hydra.runtime.config_sources)
    if "algo" in choices:
        config.algo.name = choices["algo"].rpartition("/")[2]
    name, chosen = config.env.name, choices.get("env")
    if chosen is None or name == chosen:
        return
    config.env.name = env_name(name, chosen, hydra.runtime.config_sources)
    if config.env.name == name and name in env_names():
        raise ValueError(
            f"env.name={name} would train env={chosen} under the name of another environment. To "
            f"choose that one, write env={name}."
        )


def _refuse_hidden_files(choices: Iterable[tuple[str, Any]], sources: Iterable[Any]) -> None:
    """Refuse a chosen file of the user's that Hydra does not read: the package's has its name."""
    folders = [Path(source.path).resolve() for source in sources if source.schema == "file"]
    for group, name in choices:
        files = (folder / group.partition("@")[0] / f"{name}.yaml" for folder in folders)
        found = [file for file in files if file.is_file()]
        own = [file for file in found if not file.is_relative_to(CONF.resolve())]
        if own and own[0] != found[0]:
            raise ValueError(
                f"{group}={name}: {own[0]} would have no effect, because the package has one of "
                "this name. Rename your file."
            )


OmegaConf.register_new_resolver("safe_rl.env_name", env_name, replace=True)
OmegaConf.register_new_resolver("safe_rl.job_name", job_name, replace=True)
