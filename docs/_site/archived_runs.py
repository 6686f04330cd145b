"""Runs in results/: their tables, what settings they had, and what certificates they ended with."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pandas import DataFrame

from safe_rl.reporting.archive import find_runs
from safe_rl.reporting.recorded import Run
from safe_rl.runs.identity import experiment_of

Settings = Mapping[str, Hashable]


@cache
def runs_of(archive: Path) -> dict[tuple[str, str], dict[int, Run]]:
    """Runs of a campaign by environment and algorithm, and then by seed."""
    found: dict[tuple[str, str], dict[int, Run]] = {}
    for run in sorted(find_runs(archive)[0], key=lambda run: run.seed):
        env, algo, *_ = run.directory.relative_to(archive).parts
        found.setdefault((env, algo), {})[run.seed] = run
    return found


def finished_runs(archive: Path, algo: str, env: str, frames: int) -> dict[int, DataFrame]:
    """Recorded tables by seed of runs that came to their end, a row per epoch."""
    runs = runs_of(archive).get((env, algo), {})
    return {seed: DataFrame(run.table) for seed, run in runs.items() if run.steps >= frames}


def groups(archive: Path, algo: str, env: str, seeds: list[int]) -> list[tuple[str, list[int]]]:
    """Seeds by the settings with which they were run, in the order of the seeds.

    Returns:
        Overrides that tell a group from the others, "" if there is one group, and its seeds. A
        setting that one of two runs lacks, because it came later, tells them not apart.
    """
    settings = {seed: _settings(archive, env, algo, seed) for seed in seeds}
    found: list[list[int]] = []
    for seed in seeds:
        alike = (g for g in found if not _differing(settings[g[0]], settings[seed]))
        group = next(alike, None)
        if group is None:
            found.append([seed])
        else:
            group.append(seed)
    telling = set().union(
        *(_differing(settings[a[0]], settings[b[0]]) for a in found for b in found)
    )
    return [
        (" ".join(f"{key}={settings[group[0]].get(key)}" for key in sorted(telling)), group)
        for group in found
    ]


def certificates(archive: Path, algo: str, env: str, seeds: list[int]) -> str:
    """How many of the runs that were tested are certified: "1 of 2"; a dash if none was."""
    runs = runs_of(archive)[env, algo]
    told = [runs[seed].certificate for seed in seeds]
    tested = [each["checkpoint"] is not None for each in told if each is not None]
    return f"{sum(tested)} of {len(tested)}" if tested else "—"


def _differing(some: Settings, others: Settings) -> set[str]:
    return {key for key in some.keys() & others.keys() if some[key] != others[key]}


@cache
def _settings(archive: Path, env: str, algo: str, seed: int) -> dict[str, Any]:
    """What names a run's experiment."""
    return experiment_of(runs_of(archive)[env, algo][seed].config)
