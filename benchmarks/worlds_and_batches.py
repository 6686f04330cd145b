"""Which number of environments and which batch size learn best in the same time.

    python benchmarks/worlds_and_batches.py env=CarGoal1 --seconds 65

The script measures whole training epochs for every number of environments and every batch size. It
prints the command of a run of each kind, with as many steps as fit into the seconds. The integral
gain is proportional to the batch, so that λ changes equally fast per step. With `--table`, it
prints what finished runs have reached:

    python benchmarks/worlds_and_batches.py --table results/worlds/equal_seconds.csv.gz
"""

import argparse
import csv
import gzip
import itertools
import statistics
import tempfile
from pathlib import Path

import numpy as np
from train_throughput import compose_config, new_env

from safe_rl.training.building import build_trainer, seed_everything

NUM_ENVS = (20, 50, 100, 200)
BATCHES = (10_000, 20_000, 40_000)
GAIN = 0.4 / 20_000  # lagrangian.ki per step of a batch
LAST = 0.2  # share of a run that the table describes; the limit is constant from 0.7 on


def cell(num_envs, batch):
    """Overrides of a run with these two numbers."""
    return [f"num_envs={num_envs}", f"frames_per_batch={batch}", f"lagrangian.ki={GAIN * batch:g}"]


def steps_per_second(overrides, epochs):
    """Median over epochs of a run, the first left out."""
    config = compose_config(overrides)
    seed_everything(config.seed, config.num_threads)
    with tempfile.TemporaryDirectory() as directory:
        trainer = build_trainer(config, new_env(config), Path(directory))
        batches = iter(trainer.collector)
        rows = [trainer.epoch(batches) for _ in range(epochs + 1)][1:]
    seconds = statistics.median(row["time_collect"] + row["time_learn"] for row in rows)
    return config.frames_per_batch / seconds


def plan(overrides, seconds, epochs):
    """Print the rate of every cell, and the command of a run of so many seconds."""
    for num_envs, batch in itertools.product(NUM_ENVS, BATCHES):
        options = [*overrides, "algo=ppo_lagrangian", *cell(num_envs, batch)]
        rate = steps_per_second(options, epochs)
        frames = max(1, round(rate * seconds / BATCHES[-1])) * BATCHES[-1]
        print(f"{rate:,.0f} steps/s: python train.py {' '.join(options)} frames={frames}")


def outcomes(path):
    """Mean return and cost of the end of every run: (env, num_envs, batch) -> rows of seeds."""
    with gzip.open(path, "rt") as file:
        rows = list(csv.DictReader(file))
    runs = {}
    for row in rows:
        key = (row["env"], int(row["num_envs"]), int(row["frames_per_batch"]))
        figures = [float(row[name]) for name in ("steps", "episode_return", "episode_cost")]
        runs.setdefault(key, {}).setdefault(int(row["seed"]), []).append(figures)
    found = {}
    for key, seeds in runs.items():
        for epochs in map(np.array, seeds.values()):
            end = epochs[epochs[:, 0] > (1 - LAST) * epochs[-1, 0]]
            found.setdefault(key, []).append(np.nanmean(end[:, 1:], axis=0))
    return found


def table(path):
    """Rows of a number of environments, with a column per batch: return / cost of every seed."""
    found = outcomes(path)
    batches = sorted({batch for _, _, batch in found})
    for env in dict.fromkeys(env for env, _, _ in found):
        for num_envs in sorted({n for name, n, _ in found if name == env}):
            cells = (found.get((env, num_envs, batch), []) for batch in batches)
            told = ("; ".join(f"{r:.1f} / {c:.0f}" for r, c in seeds) for seeds in cells)
            yield f"| {env} | {num_envs} | {' | '.join(told)} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="*", help="as train.py takes them")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--table", help="epochs of runs, to print the table of")
    options = parser.parse_args()
    if options.table:
        print(*table(options.table), sep="\n")
    else:
        plan(options.overrides, options.seconds, options.epochs)


if __name__ == "__main__":
    main()
