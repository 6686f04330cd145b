"""Experiments whose runs started from other runs' networks (paper section 6), and from which."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import OmegaConf

from safe_rl.reporting.experiments import Experiment, environment_names
from safe_rl.reporting.runs import Run, read_run
from safe_rl.runs.checkpoints import CheckpointStore
from safe_rl.runs.folder import RunFolder, run_of
from safe_rl.scores.published import ALGORITHMS

__all__ = ["Transfer", "find_transfers"]


@dataclass(frozen=True)
class Transfer:
    """Training on one environment that was continued on another one.

    Attributes:
        first: The runs it started from, up to the checkpoints that were taken; one experiment as a
            rule, none if no run was found.
        second: The runs that started from them.
        changes: Environment steps of the first phase, ascending; one number unless the seeds
            started from checkpoints of different ages.
        missing: What ``init_from`` names and was not found, of each run of the second phase.
    """

    first: tuple[Experiment, ...]
    second: Experiment
    changes: tuple[int, ...]
    missing: tuple[Path, ...]

    @property
    def offset(self) -> int:
        """Environment steps at which the second phase is drawn to begin."""
        return max(self.changes, default=0)

    @property
    def title(self) -> str:
        """Both environments and the algorithm."""
        before = " / ".join(dict.fromkeys(e.environment for e in self.first)) or "?"
        return f"{before} → {self.second.environment}, {self.second.algorithm}"

    @property
    def notes(self) -> list[str]:
        """What has to be said beside the figure, in sentences."""
        notes = []
        if self.missing:
            names = ", ".join(map(str, dict.fromkeys(self.missing)))
            shown = "the first phase is that of the others" if self.first else "drawn alone"
            notes.append(f"The run it started from was not found ({names}): {shown}.")
        if len(self.changes) > 1:
            notes.append(
                f"The seeds started from checkpoints after {self.changes[0]:,} to "
                f"{self.changes[-1]:,} steps: the second phase is averaged over steps of its own "
                "and drawn from the last of these."
            )
        return notes


class _Origin(NamedTuple):
    """A run that another one started from, up to the checkpoint."""

    run: Run
    steps: int


def find_transfers(
    experiments: Sequence[Experiment],
    runs: Sequence[Run],
    suite: Mapping[str, Mapping[str, Any]],
) -> list[Transfer]:
    """Find the experiments that continue others.

    Args:
        experiments: All experiments.
        runs: All runs, also those that no experiment has kept.
        suite: Name -> every key of a benchmark environment.
    """
    known = {run.directory.resolve(): run for run in runs}
    origins = {
        run.directory: _origin(run, known)
        for experiment in experiments
        for run in experiment.runs
        if run.init_from is not None
    }
    found = [origin.run for origin in origins.values() if origin is not None]
    environments = environment_names([*runs, *found], suite)
    names = {run.directory: e.algorithm for e in experiments for run in e.runs}
    return [
        _transfer(experiment, origins, environments, names)
        for experiment in experiments
        if any(run.directory in origins for run in experiment.runs)
    ]


def _transfer(
    second: Experiment,
    origins: Mapping[Path, _Origin | None],
    environments: Mapping[Path, str],
    algorithms: Mapping[Path, str],
) -> Transfer:
    found: dict[Path, _Origin] = {}
    changes: set[int] = set()
    missing: list[Path] = []
    for run in second.runs:
        origin = origins.get(run.directory)
        if origin is not None:
            changes.add(origin.steps)
            # several seeds may start from one run, which is one sample
            known = found.setdefault(origin.run.directory, origin)
            found[origin.run.directory] = max(known, origin, key=lambda o: o.steps)
        elif run.init_from is not None:
            missing.append(run.init_from)
    phases: dict[tuple[str, str, Hashable], list[Run]] = defaultdict(list)
    for directory, origin in found.items():
        algorithm = origin.run.algorithm
        name = algorithms.get(directory, ALGORITHMS.get(algorithm, algorithm))
        limits = tuple(sorted(origin.run.limits.items()))
        phases[environments[directory], name, limits].append(_until(*origin))
    first = tuple(
        Experiment(environment, algorithm, None, tuple(members))
        for (environment, algorithm, _), members in phases.items()
    )
    return Transfer(first, second, tuple(sorted(changes)), tuple(missing))


def _origin(run: Run, known: Mapping[Path, Run]) -> _Origin | None:
    """The run that ``init_from`` names, or None if there is none to be found.

    Of a run without the name of a checkpoint, the newest was taken; where none is kept any more,
    that is where its table ends.
    """
    for source in _places(run):
        folder, steps = run_of(source)
        outcome = known.get(folder)
        if outcome is None and RunFolder(folder).is_run:
            outcome = _read(folder)
        if outcome is not None and folder != run.directory.resolve():
            newest = CheckpointStore.newest_step(RunFolder(folder).checkpoints)
            origin = _Origin(outcome, steps or newest or outcome.steps)
            # a table that begins after the checkpoint is another run's
            return origin if outcome.table["steps"][0] <= origin.steps else None
    return None


def _read(folder: Path) -> Run | None:
    outcome = read_run(folder)
    return outcome if isinstance(outcome, Run) else None


def _places(run: Run) -> Iterator[Path]:
    """Where ``init_from`` may be, absolute: below the run's working directory, if it is recorded.

    Where it is not, or the runs have been moved since, it is sought from the folders above the run
    upwards, then from the current one.
    """
    assert run.init_from is not None
    record = RunFolder(run.directory).surroundings
    if record.is_file():
        directory = OmegaConf.select(OmegaConf.load(record), "hydra.runtime.cwd")
        if directory is not None:
            yield (Path(directory) / run.init_from).resolve()
    for above in (*run.directory.resolve().parents, Path.cwd()):
        yield (above / run.init_from).resolve()


def _until(run: Run, steps: int) -> Run:
    """A run as it was after so many steps, which counts as its end."""
    rows = sum(reached <= steps for reached in run.table["steps"])
    return replace(run, table={name: values[:rows] for name, values in run.table.items()}, frames=0)
