"""Run folders as training leaves them, with numbers that are chosen instead of learned."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import yaml

from safe_rl.cli.report import suite
from safe_rl.reporting.archive import read_runs
from safe_rl.reporting.experiments import group_runs

COLUMNS = [
    *("epoch", "steps", "episodes", "episode_return", "episode_cost", "cost_rate", "time_total"),
]
SUITE = suite()


def estimate(value):
    return {"value": value, "low": value - 1, "high": value + 1}


EVALUATION = {
    "checkpoint": "last", "steps": 3000, "episodes": 100, "deterministic": True, "env": {"x": 1},
    "layouts_trained_on": 0.0, "cost_limits": {"cost": 25.0}, "cvar_alpha": 0.1,
    "estimates": {
        "episode_return": estimate(12.0), "episode_cost": estimate(21.0),
        "cvar_cost": estimate(70.0), "over_limit_cost": estimate(0.25),
    },
}  # fmt: skip


def grouped(root: Path):
    """Experiments below a folder, and the repetitions that were left out."""
    runs, _ = read_runs(root)
    return group_runs(runs, SUITE)


def experiments_in(root: Path):
    """Experiments below a folder."""
    return grouped(root)[0]


def texts_of(table):
    """What a reader sees, by column, row by row."""
    return [
        dict(zip(table.columns, (cell.text for cell in row), strict=True)) for row in table.rows()
    ]


def marks(table, title):
    """Marks of a column, row by row."""
    place = list(table.columns).index(title)
    return [row[place].mark for row in table.rows()]


def write_run(
    root: Path,
    env: str = "PointGoal1",
    algo: str = "ppo",
    seed: int = 0,
    *,
    epochs=1,
    returns=1.0,
    costs=30.0,
    rates=0.03,
    frames: int | None = None,
    env_changes: dict | None = None,
    limits: dict | None = None,
    overrides: list[str] | None = None,
    folder: str | None = None,
    columns: dict | None = None,
    **settings,
) -> Path:
    """One row of the table per epoch, 1000 steps and 3.6 s apart.

    `returns`, `costs` and `rates` are of one epoch each, or a number for all of them. `columns` are
    further ones, by name; those of limited costs are there.
    """
    epochs = max([epochs, *(np.size(values) for values in (returns, costs, rates))])
    returns, costs, rates = (
        [values] * epochs if np.isscalar(values) else values for values in (returns, costs, rates)
    )
    directory = root / env / algo / (folder or f"seed{seed}")
    (directory / ".hydra").mkdir(parents=True)
    config = {
        "env": {**SUITE.environments.get(env, {"name": env}), **(env_changes or {})},
        "algo": {"name": algo},
        "seed": seed,
        "frames": 1000 * epochs if frames is None else frames,
        "cost_limits": {"cost": 25.0} if limits is None else limits,
        "preset": "default",
        "device": "cpu",
        **settings,
    }
    (directory / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    said = [f"env={env}", f"algo={algo}", f"seed={seed}"] if overrides is None else overrides
    (directory / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(said))
    (directory / ".hydra" / "config.yaml").write_text("not: this one")
    with (directory / "progress.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        limited = {key: (costs, rates) for key in config["cost_limits"] if key != "cost"}
        more = {f"episode_{key}": values for key, (values, _) in limited.items()}
        more |= {f"{key}_rate": values for key, (_, values) in limited.items()}
        more |= columns or {}
        writer.writerow([*COLUMNS, *more])
        for epoch, row in enumerate(zip(returns, costs, rates, strict=True), start=1):
            further = [values[epoch - 1] for values in more.values()]
            writer.writerow([epoch, 1000 * epoch, 1, *row, 3.6 * epoch, *further])
    return directory
