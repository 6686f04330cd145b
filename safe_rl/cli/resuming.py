"""``resume=RUN``: the configuration of a run's folder, with the overrides of the command.

The file may come from somebody else. It is read as plain values; Hydra gets these values, and
never the file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.user_code import check_imports
from safe_rl.files import read_config
from safe_rl.runs.identity import flatten, role_of
from safe_rl.runs.run import Run

RESUMED = "resumed"
"""Name in Hydra's ConfigStore of the configuration of a run that is continued."""


def read_resumed(
    directory: Path, modules: Sequence[str] | None, words: Sequence[str]
) -> dict[str, Any]:
    """Read a run's configuration as a primary configuration for Hydra.

    Args:
        directory: Folder of the run.
        modules: Modules that the command has imported; None if it names none.
        words: The other words of the command.

    Raises:
        ValueError: If it is not the folder of a run that can be continued, or if a word does not
            go with ``resume=``.
    """
    config = _read(directory)
    check_imports(config, modules, directory)
    for word in words:
        key = word.lstrip("+~").partition("=")[0]
        if word in ("-m", "--multirun") or key in ("hydra.run.dir", "hydra.sweep.dir"):
            raise ValueError(
                f"'{word}': resume= continues one run in its folder. To continue a sweep, start it "
                "again as it was: finished runs are skipped, interrupted ones continue."
            )
    _refuse_foreign_cluster(config, words, directory)
    if modules is not None:
        config["import"] = list(modules)
    place = str(directory).replace("${", "\\${")
    return {
        "defaults": ["_self_", {"override hydra/job_logging": "stdout"}],
        "hydra": {"run": {"dir": place}, "output_subdir": None},
        **config,
    }


def _read(directory: Path) -> dict[str, Any]:
    run = Run(directory)
    try:
        config = dict(run.settings)
        if run.checkpoints_folder.exists() and not run.has_begun:
            raise ValueError("it has no progress.csv: an exported policy cannot be trained on")
        for key in ("hydra", "defaults"):
            if key in config:
                raise ValueError(f"{run.config_file.name} has the key '{key}', which no run writes")
        return config
    except (OSError, ValueError) as error:
        raise ValueError(f"resume={directory}: {error}") from None


def _refuse_foreign_cluster(
    config: Mapping[str, Any], words: Sequence[str], directory: Path
) -> None:
    """Refuse settings of Ray that come from a file: they can run code, so the user gives them."""
    given = {word.lstrip("+").partition("=")[0] for word in words}
    for key, value in flatten({"collector": config.get("collector") or {}}).items():
        is_of_ray = re.match(r"collector\.(ray_init|resources)\.(?!num_[cg]pus$)", key)
        if is_of_ray and value is not None and key not in given:
            raise ValueError(
                f"{directory} has {key}. It is not taken from a file, because it could run code: "
                f"give it again, {key}=…"
            )


def refuse_changes(directory: Path, config: DictConfig) -> None:
    """Refuse a configuration that differs from the run's in a key that has to stay.

    Raises:
        ValueError: If there is such a key; the message names it.
    """
    before = flatten(read_config(Run(directory).config_file))
    settings = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    now = flatten(OmegaConf.to_container(settings, resolve=True))  # type: ignore[arg-type]
    for key in sorted({*before, *now}):
        if before.get(key) != now.get(key) and not role_of(key).may_change:
            raise ValueError(
                f"{key}={now.get(key)} cannot change in a run that is continued (it was "
                f"{before.get(key)}). You may change frames, keys of the machine such as "
                "checkpoint.interval, and single numbers below loss, limits, policy_update and so "
                "on, but not an optimiser's lr: the checkpoint has it. For a new run from this "
                f"run's networks use {quote(f'init_from={quote(str(directory))}')}."
            )
