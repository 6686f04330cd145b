"""Names of runs and of their folders: what was chosen, and resolvers for ``conf/config.yaml``."""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from safe_rl.envs.families import env_names
from safe_rl.files import CONF


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


def short_name(name: str) -> str:
    """The name of one folder: without slashes, and of one over 255 bytes its beginning and a hash.

    Examples:
        >>> short_name("init_from=../a"), short_name("a" * 300) == "a" * 200 + "-9835fa6b"
        ('init_from=.._a', True)
    """
    name = name.replace("/", "_")
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
    choices = hydra.runtime.choices
    chosen_names = [*choices.items()]
    for word in hydra.overrides.task:
        names = [n.strip() for n in str(word).partition("=[")[2].rstrip("]").split(",")]
        if word.startswith("transforms=["):
            chosen_names += [("transforms", name) for name in names]
            if len(set(names)) < len(names):
                raise ValueError(f"{word}: a transform is there twice, and would be applied once.")
    _refuse_hidden_files(chosen_names, hydra.runtime.config_sources)
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
OmegaConf.register_new_resolver("safe_rl.short_name", short_name, replace=True)
