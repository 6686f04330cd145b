"""Seconds per policy update and per pass over policy and critics, on synthetic data.

    python benchmarks/update_throughput.py --samples 30000 --threads 2

Networks are tanh perceptrons (256, 256). Observations, actions and advantages are random, which
does not change the work of an update, except for the line search of a trust-region step; the
number of its backtracks is printed. Matrices are multiplied as in runs, by oneDNN where it is
faster. On a busy machine, compare the processor time of one thread.
"""

from __future__ import annotations

import argparse
import functools
import statistics
import time
from collections.abc import Callable

import safe_rl  # isort: skip  # noqa: F401, before torch, for its settings of threads
import torch
from tensordict import TensorDict

from safe_rl.algorithms import CPOStep, TRPOStep, fast_products
from safe_rl.algorithms.minibatch import MinibatchUpdate
from safe_rl.models import make_actor, make_critic
from safe_rl.objectives import (
    CPOLoss,
    CriticLoss,
    LagrangeMultiplier,
    LimitState,
    PPOLagrangianLoss,
    TRPOLagrangianLoss,
)

TRUST_REGION = {
    "target_kl": 0.01,
    "damping": 0.1,
    "cg_iterations": 10,
    "backtrack_coeff": 0.8,
    "max_backtracks": 10,
}
HIDDEN, ACTIONS = (256, 256), 2


def make_batch(actor, samples: int, observation_size: int) -> TensorDict:
    """A batch [B] sampled by the actor, with random advantages and value targets."""
    batch = TensorDict(observation=torch.randn(samples, observation_size), batch_size=[samples])
    with torch.no_grad():
        distribution = actor.get_dist(batch)
        batch["action"] = distribution.sample()
        batch["action_log_prob"] = distribution.log_prob(batch["action"])
        batch["loc"], batch["scale"] = distribution.base_dist.loc, distribution.base_dist.scale
    for key in ("advantage", "cost_advantage", "value_target", "cost_value_target"):
        batch[key] = torch.randn(samples, 1)
    # Advantages that depend on state and action, so that there is something to learn.
    batch["advantage"] += batch["action"][:, :1] * batch["observation"][:, :1]
    batch["cost_advantage"] += batch["action"][:, 1:] * batch["observation"][:, 1:2]
    return batch


def measure(update: Callable[[], dict], repeats: int) -> tuple[float, float, dict]:
    """Median wall-clock and processor seconds of an update, warm-up (and compilation) left out."""
    for _ in range(2):
        update()
    wall, processor, metrics = [], [], {}
    for _ in range(repeats):
        start, used = time.perf_counter(), time.process_time()
        metrics = update()
        wall.append(time.perf_counter() - start)
        processor.append(time.process_time() - used)
    return statistics.median(wall), statistics.median(processor), metrics


def one_pass(actor, batch, observation_size: int, minibatch_size: int):
    """One pass of PPO-Lagrangian and of both critics over the batch."""
    settings = {
        "optimizer": functools.partial(torch.optim.Adam, lr=3e-4, fused=True),
        "num_passes": 1,
        "minibatch_size": minibatch_size,
        "compile": True,
    }
    multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
    critics = [
        make_critic(observation_size, hidden_sizes=HIDDEN, out_key=key)
        for key in ("state_value", "cost_value")
    ]
    loss = PPOLagrangianLoss(actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
    policy = MinibatchUpdate(loss, **settings)
    critic = MinibatchUpdate(CriticLoss(*critics), **settings)
    return lambda: policy(batch) | critic(batch)


def main() -> None:
    """Measure and print one line per update."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=30_000)
    parser.add_argument("--observation-size", type=int, default=60)
    parser.add_argument("--minibatch-size", type=int, default=512)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)

    actor = make_actor(args.observation_size, ACTIONS, hidden_sizes=HIDDEN, initial_log_std=-0.5)
    batch = make_batch(actor, args.samples, args.observation_size)
    multiplier = LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05)
    trpo = TRPOLagrangianLoss(actor, multiplier, entropy_coeff=0.0)
    cpo = CPOLoss(actor, entropy_coeff=0.0)
    limits = LimitState.of(cost=[30.0], limit=[25.0], length=1000.0)
    parameters = {name: value.clone() for name, value in actor.state_dict().items()}

    def from_the_start(update: Callable[[], dict]) -> Callable[[], dict]:
        def repeated() -> dict:
            actor.load_state_dict(parameters)
            return update()

        return repeated

    updates = {
        "pass over policy and two critics": one_pass(
            actor, batch, args.observation_size, args.minibatch_size
        )
    }
    for step in (TRPOStep(trpo, **TRUST_REGION), CPOStep(cpo, **TRUST_REGION)):
        updates[type(step).__name__] = functools.partial(step, batch, limits)
    print(f"{args.samples} samples, observation size {args.observation_size}, {HIDDEN}, "
          f"{args.threads} threads; median of {args.repeats}\n")  # fmt: skip
    print("| update | seconds | of processor time | backtracks |\n|---|---|---|---|")
    for name, update in updates.items():
        with fast_products():
            wall, processor, metrics = measure(from_the_start(update), args.repeats)
        tries = metrics.get("backtracks", "")
        print(f"| {name} | {wall:.2f} | {processor:.2f} | {tries} |")


if __name__ == "__main__":
    main()
