"""Which run another one started from (``init_from``), among the runs of the same folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from safe_rl.reporting.recorded import Run
from safe_rl.runs.folder import RunFolder, checkpoint_steps, common_source, run_of

__all__ = ["Origin", "find_origins", "source_of_seeds"]


class Origin(NamedTuple):
    """A run that another one started from, and the environment steps of the checkpoint."""

    run: Run
    steps: int


def find_origins(runs: Sequence[Run]) -> dict[Path, Origin]:
    """Folder of a run -> what it started from, where that is one of the runs.

    A relative path counts from where the run was started, if that is recorded. Where nothing is
    there, as when all has been moved since, it is sought from the folders above the run upwards.
    Nothing is read beyond the runs themselves.
    """
    known = {run.directory.resolve(): run for run in runs}
    origins = {}
    for run in runs:
        if run.init_from is None:
            continue
        folder, steps = run_of(run.init_from)
        first = next(filter(None, (known.get(place) for place in _places(run, folder))), None)
        if first is not None:
            newest = RunFolder(first.directory).newest_checkpoint()
            steps = steps or (newest and checkpoint_steps(newest)) or first.steps
            # a table that begins after the checkpoint is another run's
            if first is not run and first.table["steps"][0] <= steps:
                origins[run.directory] = Origin(first, steps)
    return origins


def source_of_seeds(run: Run, origin: Origin | None, root: Path) -> str:
    """The part of ``init_from`` that all seeds share, each of which starts from its own run.

    Below the folder of all runs it is relative to that.
    """
    assert run.init_from is not None
    folder, _ = run_of(run.init_from)
    place = folder if origin is None else origin.run.directory
    roots = (root, root.resolve())
    below = next((place.relative_to(r) for r in roots if r in place.parents), place)
    common = common_source(str(below / run.init_from.relative_to(folder)))
    # all runs in one folder: the name of the environment says more than a dot
    name = folder if origin is None else origin.run.config["env"].get("name")
    return str(name) if common == "." else common


def _places(run: Run, folder: Path) -> list[Path]:
    recorded = [] if run.cwd is None else [(run.cwd / folder).resolve()]
    if any(path.exists() for path in recorded):
        return recorded
    return [(above / folder).resolve() for above in run.directory.resolve().parents]
