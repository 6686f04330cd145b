"""Names of the folders of runs: resolvers for ``conf/config.yaml``."""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from safe_rl.envs.families import env_names


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
    """A name that file systems can hold: of one over 255 bytes its beginning and a hash.

    Examples:
        >>> short_name("frames=3"), short_name("a" * 300) == "a" * 200 + "-9835fa6b"
        ('frames=3', True)
    """
    if all(len(part.encode()) <= 255 for part in name.split("/")):
        return name
    beginning = name.encode()[:200].decode(errors="ignore")
    return f"{beginning}-{sha256(name.encode()).hexdigest()[:8]}"


OmegaConf.register_new_resolver("safe_rl.env_name", env_name, replace=True)
OmegaConf.register_new_resolver("safe_rl.short_name", short_name, replace=True)
