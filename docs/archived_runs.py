"""Runs in results/: their tables, what settings they had, and what certificates they ended with."""

from __future__ import annotations

import csv
import gzip
import json
from collections.abc import Hashable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from safe_rl.runs.identity import experiment_of

Rows = list[dict[str, float]]
Settings = Mapping[str, Hashable]


def finished_runs(archive: Path, algo: str, env: str, frames: int) -> dict[int, Rows]:
    """Rows of the recorded tables by seed, numbers only, of runs that came to their end."""
    found = {}
    for path in sorted((archive / env / algo).glob("seed*/progress.csv.gz")):
        with gzip.open(path, "rt") as table:
            rows = [
                {key: float(value) for key, value in row.items() if value}
                for row in csv.DictReader(table)
            ]
        if rows[-1]["steps"] >= frames:
            found[int(path.parent.name.removeprefix("seed"))] = rows
    return found


def groups(archive: Path, algo: str, env: str, seeds: list[int]) -> list[tuple[str, list[int]]]:
    """Seeds by the settings with which they were run, in the order of the seeds.

    Returns:
        Overrides that tell a group from the others, "" if there is one group, and its seeds. A
        setting that one of two runs lacks, because it came later, tells them not apart.
    """
    settings = {seed: _settings(archive / env / algo / f"seed{seed}") for seed in seeds}
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
    paths = (archive / env / algo / f"seed{seed}" / "certificate.json" for seed in seeds)
    tested = [json.loads(path.read_text())["certified"] for path in paths if path.exists()]
    return f"{sum(tested)} of {len(tested)}" if tested else "—"


def _differing(some: Settings, others: Settings) -> set[str]:
    return {key for key in some.keys() & others.keys() if some[key] != others[key]}


@cache
def _settings(folder: Path) -> dict[str, Any]:
    """What names a run's experiment; nothing for one without a configuration."""
    file = folder / "config.yaml"
    return experiment_of(yaml.safe_load(file.read_text())) if file.exists() else {}
