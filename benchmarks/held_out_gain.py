"""How much of the gain of a policy step on its own batch is also a gain on other batches.

Batches are collected with the policy of the last checkpoint of a run, whose algorithm has to be
on-policy and constrained. A TRPO step is taken on each of them, and its surrogate gain is computed
on this batch and on all others. A gain that occurs only on its own batch is noise of the
advantages. The size of the noise depends on λ_GAE, most of all for the costs. How much of it a step
follows depends on the number of conjugate gradient iterations.

    python benchmarks/held_out_gain.py RUN_DIR --lmbda 0.97,0.97 0.95,0.9 --cg-iterations 3 5 10

Pairs are λ_GAE of rewards and of costs. Gains on other batches are always computed with the run's
own estimators, so that rows can be compared. The table has a row per pair and number of
iterations, and a column per Lagrange multiplier: gain on its own batch / on the others ± standard
error, in thousandths.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import tempfile
from pathlib import Path

import safe_rl  # isort: skip  # noqa: F401, before torch, for its settings of threads
import torch
from omegaconf import OmegaConf
from train_throughput import new_env

from safe_rl.algorithms import TRPOStep
from safe_rl.objectives import LagrangeMultiplier, TRPOLagrangianLoss
from safe_rl.objectives.gae import normalise_advantages
from safe_rl.runs.checkpoints import CheckpointStore
from safe_rl.runs.run import Run
from safe_rl.training.building import build_trainer, seed_everything

STEP = {
    "target_kl": 0.01,
    "damping": 0.1,
    "backtrack_coeff": 0.9,
    "max_backtracks": 30,
}


def restored(run: Path, directory: Path):
    """Trainer of a run at its newest checkpoint, with another seed for what comes."""
    config = OmegaConf.load(run / "config.yaml")
    trainer = build_trainer(config, new_env(config), directory)
    CheckpointStore.load(Run(run).find_checkpoint("last"), trainer.components)
    seed_everything(12_345, None)
    return trainer


def collect(trainer, number: int) -> list:
    """Batches of the present policy, with penalised costs if a risk measure is limited."""
    batches, found = iter(trainer.collector), []
    for _ in range(number):
        batch = next(batches).clone()
        trainer.algorithm.constraints.update(batch, trainer.accounting.update(batch))
        found.append(batch)
    return found


def estimated(algorithm, batch, lmbdas: tuple[float, ...] | None):
    """The batch with advantages, standardised as in training; None: the run's own λ_GAE."""
    estimators = algorithm.advantage, algorithm.cost_advantage
    own = [estimator.lmbda for estimator in estimators]
    batch = batch.clone()
    for estimator, lmbda, before in zip(estimators, lmbdas or own, own, strict=True):
        estimator.lmbda = lmbda
        estimator(batch)
        estimator.lmbda = before
    return normalise_advantages(batch)


def gains(
    algorithm, batches, references, multiplier, cg_iterations
) -> tuple[list[float], list[float]]:
    """Surrogate gain of a step on every batch: there, and on average over all other references."""
    actor = algorithm.actor
    start = {name: tensor.clone() for name, tensor in actor.state_dict().items()}
    loss = TRPOLagrangianLoss(actor, multiplier, entropy_coeff=0.0)
    step = TRPOStep(loss, cg_iterations=cg_iterations, **STEP)

    @torch.no_grad()
    def value(batch) -> float:
        return -float(loss(batch)["loss_objective"])

    before = [value(batch) for batch in batches], [value(batch) for batch in references]
    own, others = [], []
    for index, batch in enumerate(batches):
        step(batch)
        own.append(value(batch) - before[0][index])
        others.append(
            statistics.fmean(
                value(reference) - before[1][number]
                for number, reference in enumerate(references)
                if number != index
            )
        )
        actor.load_state_dict(start)
    return own, others


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--batches", type=int, default=8)
    parser.add_argument("--lmbda", nargs="+", default=["0.97,0.97", "0.95,0.9", "0.9,0.9"])
    parser.add_argument("--cg-iterations", nargs="+", type=int, default=[10])
    parser.add_argument("--multipliers", nargs="+", type=float, default=[0.0, 1.0, 2.5])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        trainer = restored(options.run, Path(directory))
        collected = collect(trainer, options.batches)
    algorithm = trainer.algorithm
    limits = dict.fromkeys(algorithm.cost_keys, 0.0)
    references = [estimated(algorithm, batch, None) for batch in collected]
    print(
        "| λ_GAE | conjugate gradients | "
        + " | ".join(f"multiplier {m:g}" for m in options.multipliers)
        + " |"
    )
    print("|---|---|" + "---|" * len(options.multipliers))
    for pair, number in itertools.product(options.lmbda, options.cg_iterations):
        lmbdas = tuple(map(float, pair.split(",")))
        batches = [estimated(algorithm, batch, lmbdas) for batch in collected]
        cells = []
        for value in options.multipliers:
            fixed = LagrangeMultiplier(limits, init=max(value, 1e-6), lr=1.0)  # not updated
            own, others = gains(algorithm, batches, references, fixed, number)
            error = statistics.stdev(others) / math.sqrt(len(others))
            cells.append(
                f"{1e3 * statistics.fmean(own):.1f} / "
                f"{1e3 * statistics.fmean(others):.2f} ± {1e3 * error:.2f}"
            )
        print(f"| {pair} | {number} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
