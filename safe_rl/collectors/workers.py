"""Collection by several processes, on this machine or on others.

Every worker steps a share of the rows of one batched environment: with the seeds that these rows
have in a single process, so that a run meets the same kind of episodes however it is spread.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from multiprocessing import parent_process
from threading import Thread
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import MultiSyncCollector
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

__all__ = ["MakeEnv", "WorkerCollector", "make_process_collector", "make_ray_collector"]


class MakeEnv(Protocol):
    """Makes the run's environment with another number of rows; workers call it."""

    def __call__(self, *, num_envs: int) -> EnvBase:
        """Make an environment of ``num_envs`` rows."""
        ...


class WorkerCollector:
    """Batches [N, T] of the present policy, collected by workers that wait for one another.

    The workers get the policy's weights before every batch but the first, with which they start.

    Args:
        start: Starts TorchRL's collector, whose batches are [W, n, T] or [N, T].
        num_envs: Rows of all workers together, N.
        device: Device of the batches.
    """

    def __init__(self, start: Callable[[], Any], num_envs: int, device: torch.device) -> None:
        self.storing_device = device
        self._start = start
        self._workers: Any = None
        self._num_envs = num_envs

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Start the workers and collect without end.

        Raises:
            RuntimeError: If a worker has died.
        """
        self._workers = self._start()
        batches = iter(self._workers)
        while True:
            try:
                batch = next(batches)
            except RuntimeError:
                # TorchRL notices that a worker has died while it waits for its batch
                self._check_workers()
                raise
            yield batch.reshape(self._num_envs, -1).to(self.storing_device)
            self._send_weights()

    def _send_weights(self) -> None:
        """Send the weights, which for ever waits for a worker that has died, and notice that."""
        failures: list[Exception] = []

        def send() -> None:
            try:
                self._workers.update_policy_weights_()
            except Exception as error:
                failures.append(error)

        sender = Thread(target=send, daemon=True)
        sender.start()
        while sender.is_alive():
            sender.join(timeout=1.0)
            self._check_workers()
        if failures:
            raise failures[0]

    def _check_workers(self) -> None:
        """Raise if a process has ended; the others are ended then."""
        processes = [p for p in getattr(self._workers, "procs", []) if not p._closed]
        dead = [process for process in processes if not process.is_alive()]
        if not dead:
            return
        codes = ", ".join(str(process.exitcode) for process in dead)
        for process in processes:
            process.kill()
        self._workers.closed = True
        raise RuntimeError(
            f"A worker of the collector has died (exit code {codes}; -9 is mostly a lack of "
            "memory: use fewer environments). The last checkpoint is whole: continue with resume=."
        )

    def shutdown(self) -> None:
        """End the workers, if there are any."""
        if self._workers is not None and not getattr(self._workers, "closed", False):
            self._workers.shutdown()


def make_process_collector(
    env: EnvBase,
    make_env: MakeEnv,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    num_collectors: int,
    device: torch.device | str,
) -> WorkerCollector:
    """Collect in processes of this machine.

    Args:
        env: The run's environment; its rows are shared out, itself it is not stepped.
        make_env: Makes an environment like it with fewer rows, in the worker.
        policy: Policy, whose weights are sent to the workers.
        frames_per_batch: Steps of all rows together in one batch, N·T.
        num_collectors: Number of processes, W, that divides N.
        device: Device of policy and batches.

    Raises:
        ValueError: If N is not a multiple of W, or ``frames_per_batch`` of N.
    """
    check_shares(env, num_collectors, frames_per_batch)

    def start() -> MultiSyncCollector:
        return MultiSyncCollector(
            share_rows(env, make_env, num_collectors),
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            policy_device="cpu",
            env_device="cpu",
            storing_device="cpu",
            cat_results=0,
            use_buffers=True,
            auto_register_policy_transforms=False,
        )

    return WorkerCollector(start, env.batch_size.numel(), torch.device(device))


def make_ray_collector(
    env: EnvBase,
    make_env: MakeEnv,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    num_collectors: int,
    device: torch.device | str,
    ray_init: dict[str, Any],
    resources: dict[str, Any],
) -> WorkerCollector:
    """Collect in actors of a Ray cluster.

    Args:
        env: The run's environment; its rows are shared out, itself it is not stepped.
        make_env: Makes an environment like it with fewer rows, in the worker.
        policy: Policy, whose weights are sent to the workers.
        frames_per_batch: Steps of all rows together in one batch, N·T.
        num_collectors: Number of actors, W, that divides N.
        device: Device of policy and batches.
        ray_init: Arguments of ``ray.init``, such as ``address``.
        resources: Of every actor: ``num_cpus``, ``num_gpus``, ``memory``.

    Raises:
        ValueError: If N is not a multiple of W, or ``frames_per_batch`` of N.
    """
    check_shares(env, num_collectors, frames_per_batch)

    def start() -> RayCollector:
        return RayCollector(
            share_rows(env, make_env, num_collectors),
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=sys.maxsize,
            sync=True,
            ray_init_config=ray_init,
            remote_configs=resources,
            num_collectors=num_collectors,
        )

    return WorkerCollector(start, env.batch_size.numel(), torch.device(device))


def check_shares(env: EnvBase, num_collectors: int, frames_per_batch: int) -> None:
    """Refuse numbers that cannot be shared equally."""
    num_envs = env.batch_size.numel()
    if num_collectors < 1 or num_envs % num_collectors or frames_per_batch % num_envs:
        raise ValueError(
            f"{num_collectors} collectors cannot share {num_envs} environments and batches of "
            f"{frames_per_batch} frames equally: num_envs must be a multiple of num_collectors, "
            "and frames_per_batch of num_envs."
        )


def share_rows(env: EnvBase, make_env: MakeEnv, num_collectors: int) -> list[Callable[[], EnvBase]]:
    """Functions that make every worker's environment, with its share of the rows of ``env``.

    An environment with ``get_state`` and ``set_state`` has its rows continued by the workers, from
    their next reset; any other one is made anew, seeded by ``make_env``.
    """
    states: list[TensorDictBase | None]
    if not hasattr(env, "get_state"):
        states = [None] * num_collectors
    else:
        env.reset()
        states = list(env.get_state().chunk(num_collectors))
    seeds = torch.randint(2**62, (num_collectors,)).tolist()
    rows = env.batch_size.numel() // num_collectors
    return [
        partial(_make_share, make_env, rows, state, seed)
        for state, seed in zip(states, seeds, strict=True)
    ]


def _make_share(
    make_env: MakeEnv, num_envs: int, state: TensorDictBase | None, seed: int
) -> EnvBase:
    # of the policy's noise: every worker needs its own
    torch.manual_seed(seed)
    if parent_process() is not None:
        # Ctrl-C reaches every process; it is the first one's to end the run, with a checkpoint
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    env = make_env(num_envs=num_envs)
    if state is not None:
        env.set_state(state)
    return env
