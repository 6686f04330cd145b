"""Updates per second of SAC-Lagrangian, beside the matrix products of its networks alone.

    python benchmarks/off_policy_throughput.py --threads 1 --repeats 10

Both compute the same matrix products, and are timed in turns in one run. The second are the
forward and backward passes of plain `torch.nn` perceptrons on a fixed minibatch, without
TensorDicts, optimiser or replay buffer. The difference between the ratio and 1 is the share of an
update that is not spent on them. Both use oneDNN where it is faster, as runs do; with ``--plain``
they use MKL.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import statistics
import time
from collections.abc import Callable
from itertools import pairwise

import safe_rl  # isort: skip  # noqa: F401, before torch, for its settings of threads
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded

from safe_rl.algorithms import Memory, ReplayUpdate, fast_products
from safe_rl.models import QEnsemble, make_squashed_actor
from safe_rl.objectives import LagrangeMultiplier, LimitState, SACLagrangianLoss

ACTIONS = 2


def perceptron(sizes: list[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for fan_in, fan_out in pairwise(sizes):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def bare(args: argparse.Namespace) -> Callable[[], None]:
    """The matrix products of one update, of two reward and two cost critics and an actor."""
    observed, hidden = args.observation_size, args.hidden
    critics = [perceptron([observed + ACTIONS, *hidden, 1]) for _ in range(4)]
    targets = [perceptron([observed + ACTIONS, *hidden, 1]) for _ in range(4)]
    actor = perceptron([observed, *hidden, 2 * ACTIONS])
    steps = torch.randn(args.batch_size, observed + ACTIONS)
    states = torch.randn(args.batch_size, observed)

    def values(networks: list[nn.Sequential], inputs: Tensor) -> Tensor:
        return sum(network(inputs).sum() for network in networks)

    def update() -> None:
        for network in (actor, *critics):
            network.zero_grad()
        with torch.no_grad():
            # next actions of reward and cost critics
            for _ in range(2):
                actions = actor(states)[:, :ACTIONS]
            values(targets, torch.cat([states, actions], -1))
        values(critics, steps).backward()
        for network in critics:
            network.requires_grad_(False)
        values(critics, torch.cat([states, actor(states)[:, :ACTIONS]], -1)).backward()
        for network in critics:
            network.requires_grad_(True)

    return update


def ours(args: argparse.Namespace) -> Callable[[], None]:
    """One update as runs take it: draw, losses, backward, Adam, targets."""
    spec = Bounded(-1, 1, [ACTIONS])
    layers = {"hidden_sizes": args.hidden, "num_networks": 2}
    loss = SACLagrangianLoss(
        make_squashed_actor(args.observation_size, spec.low, spec.high, hidden_sizes=args.hidden),
        QEnsemble(args.observation_size, ACTIONS, **layers),
        QEnsemble(args.observation_size, ACTIONS, out_key="cost_value", **layers),
        multiplier=LagrangeMultiplier({"cost": 25.0}, init=1.0, lr=0.05),
        cost_keys=["cost"],
        gamma=0.99,
        alpha_init=0.02,
        action_spec=spec,
    )
    memory = Memory(
        capacity=20_000, batch_size=args.batch_size, in_keys=loss.in_keys,
        summed=["reward", "cost"], gamma=0.99, n_steps=1, keep=False,
    )  # fmt: skip
    steps = random_steps(50, 400, args.observation_size)
    memory.extend(steps)
    loss.prepare(steps, LimitState.of(cost=[30.0], limit=[25.0], length=1000.0))
    update = ReplayUpdate(
        loss,
        optimizer=functools.partial(torch.optim.Adam, lr=1e-3, fused=True),
        updates_per_step=0.05,
        tau=0.01,
        policy_delay=args.policy_delay,
    )
    return lambda: update(memory, args.updates)


def random_steps(rows: int, length: int, observation_size: int) -> TensorDict:
    shape = (rows, length)
    flags = torch.zeros(*shape, 1, dtype=torch.bool)
    following = {
        "observation": torch.randn(*shape, observation_size), "reward": torch.randn(*shape, 1),
        "cost": torch.rand(*shape, 1), "done": flags, "terminated": flags,
    }  # fmt: skip
    return TensorDict(
        observation=torch.randn(*shape, observation_size), action=torch.rand(*shape, ACTIONS),
        next=following, batch_size=shape,
    )  # fmt: skip


def seconds(call: Callable[[], None]) -> tuple[float, float]:
    start, used = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - start, time.process_time() - used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hidden", type=int, nargs="+", default=[128, 128])
    parser.add_argument("--policy-delay", type=int, default=1)
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--observation-size", type=int, default=60)
    parser.add_argument("--updates", type=int, default=50)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--plain", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    update, arithmetic = ours(args), bare(args)
    calls = {
        "updates": update,
        "arithmetic": lambda: [arithmetic() for _ in range(args.updates)],
    }
    for call in calls.values():
        call()
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    with contextlib.nullcontext() if args.plain else fast_products():
        for _ in range(args.repeats):
            for name, call in calls.items():
                taken[name].append(seconds(call))
    print(f"{args.hidden}, minibatches of {args.batch_size}, {args.threads} threads\n")
    print("| | updates/s | arithmetic alone | ratio |\n|---|---|---|---|")
    for kind, name in enumerate(("wall clock", "processor")):
        rates = {
            key: args.updates / statistics.median(times[kind] for times in values)
            for key, values in taken.items()
        }
        ratios = [
            bare[kind] / ours[kind]
            for ours, bare in zip(taken["updates"], taken["arithmetic"], strict=True)
        ]
        cells = (*(f"{rate:.1f}" for rate in rates.values()), f"{statistics.median(ratios):.2f}")
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
