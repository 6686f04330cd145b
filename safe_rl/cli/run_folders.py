"""New runs get folders of their own, note there how they were begun, and take them back."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

from hydra.conf import HydraConf
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, read_write

from safe_rl.runs.files import replacing
from safe_rl.runs.folder import RunFolder

__all__ = ["NewFolder", "note_missing", "remove_new", "write_notes"]

_missing: set[Path] = set()  # before this process made folders of runs


class NewFolder(Callback):
    """Makes the folder of a single run before anything is written, so that it is nobody else's.

    Where the name is taken, by a run that began in the same second say, it gets a number. A folder
    that the command line names is left as it is.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Make the folder and tell Hydra."""
        note_missing(Path(config.hydra.run.dir))
        if any(o.lstrip("+").startswith("hydra.run.dir=") for o in config.hydra.overrides.hydra):
            return
        wanted = Path(config.hydra.run.dir)
        made = next(path for path in _names(wanted) if _make(path))
        with read_write(config.hydra.run):
            config.hydra.run.dir = str(made)


def note_missing(folder: Path) -> None:
    """Note which folders are not there yet, of one that will be made and of those above it."""
    place = Path(os.path.abspath(folder))
    _missing.update(path for path in (place, *place.parents) if not path.exists())


def remove_new(folder: Path) -> None:
    """Remove the folder of a run that could not begin, and empty ones above that were missing.

    Examples:
        >>> above = getfixture("tmp_path")
        >>> note_missing(above / "PointGoal1" / "cpo" / "seed0")
        >>> (above / "PointGoal1" / "cpo" / "seed0").mkdir(parents=True)
        >>> remove_new(above / "PointGoal1" / "cpo" / "seed0")
        >>> above.exists(), (above / "PointGoal1").exists()
        (True, False)
    """
    shutil.rmtree(folder, ignore_errors=True)
    for above in Path(os.path.abspath(folder)).parents:
        try:
            if above in _missing:
                above.rmdir()
        except OSError:  # other runs have come into it
            return


def _names(path: Path) -> Iterator[Path]:
    yield path
    yield from (path.with_name(f"{path.name}_{number}") for number in count(2))


def _make(path: Path) -> bool:
    """Make a folder; False if it is there."""
    try:
        path.mkdir(parents=True)
    except FileExistsError:
        return False
    return True


def write_notes(folder: RunFolder, config: DictConfig, hydra: HydraConf | DictConfig) -> None:
    """Write Hydra's notes, which it would write before it is known whether a run may begin here.

    Args:
        folder: Of the run.
        config: Its configuration.
        hydra: Hydra's own.
    """
    folder.notes.mkdir(exist_ok=True)
    notes = ((folder.composed, config), (folder.surroundings, OmegaConf.create({"hydra": hydra})),
             (folder.overrides, hydra.overrides.task))  # fmt: skip
    for path, content in notes:
        with replacing(path) as unfinished:
            OmegaConf.save(content, unfinished)
