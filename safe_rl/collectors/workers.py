"""Collection by several processes, on this machine or on others.

Every worker steps a share of the rows of one batched environment, see `safe_rl.collectors.shares`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from threading import Thread
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import MultiSyncCollector
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

from safe_rl.collectors.ahead import behind
from safe_rl.collectors.ending import end_processes
from safe_rl.collectors.shares import MakeEnv, check_shares, share_rows
from safe_rl.processes import is_stopped, starting_processes

__all__ = ["WorkerCollector", "make_process_collector", "make_ray_collector"]

Known = Callable[[Any], None]
"""Takes note of a collector of TorchRL's."""

_MOST_LOOKS = 5
"""Seconds for which a worker may be missing: a job that is put to sleep as a whole wakes so."""


class WorkerCollector:
    """Batches [N, T] of the present policy, collected by workers that wait for one another.

    The workers get the policy's weights before every batch but the first, with which they start.

    Args:
        start: Starts TorchRL's collector, whose batches are [W, n, T] or [N, T], and hands it, as
            soon as it has processes, to the function that ``start`` is given.
        num_envs: Rows of all workers together, N.
        device: Device of the batches.
        refresh: None, or what a batch is put through if the workers are to collect the next one
            while it is learned from: it is then of the policy before the last update.
    """

    def __init__(
        self,
        start: Callable[[Known], Any],
        num_envs: int,
        device: torch.device,
        refresh: Callable[[TensorDictBase], TensorDictBase] | None = None,
    ) -> None:
        self.storing_device = device
        self._start = start
        self._workers: Any = None
        self._num_envs = num_envs
        self._refresh = refresh
        self._looks = 0

    @property
    def updates_behind(self) -> int:
        """Updates of the policy that a batch comes too early for: 1 if it is collected ahead."""
        return int(self._refresh is not None)

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Start the workers and collect without end.

        Raises:
            RuntimeError: If a worker has died or stands still.
        """
        self._wait_for(_begin(lambda: self._start(self._known)))
        batches = iter(self._workers)
        asked = _begin(lambda: next(batches))
        while True:
            batch = self._wait_for(asked).reshape(self._num_envs, -1).to(self.storing_device)
            if self._refresh is not None:
                batch = self._refresh(batch)
            else:
                yield batch
            self._wait_for(_begin(self._workers.update_policy_weights_))
            asked = _begin(lambda: next(batches))
            if self._refresh is not None:
                yield batch

    def _known(self, workers: Any) -> None:
        """Take note of TorchRL's collector, which is told while it still starts its processes."""
        self._workers = workers

    def _wait_for(self, asked: Future[Any]) -> Any:
        """The result of a call that for ever waits for a worker that has died."""
        while not wait([asked], timeout=1.0).done:
            self._check_workers()
        failure = asked.exception()
        if failure is None:
            return asked.result()
        self._check_workers()
        end_processes(self._workers)
        raise failure

    def _check_workers(self) -> None:
        """Raise if a process was killed, or is missing for some time; all are ended then."""
        processes = [p for p in getattr(self._workers, "procs", []) if not p._closed]
        ended = [p.exitcode for p in processes if p.exitcode is not None]
        stopped = [p.pid for p in processes if p.pid is not None and is_stopped(p.pid)]
        self._looks = self._looks + 1 if ended or stopped else 0
        # one that has failed by itself reports that, if it is given the time
        if not set(ended) - {0, 1} and self._looks <= _MOST_LOOKS:
            return
        codes = ", ".join(map(str, ended))
        reason = (
            f"has died (exit code {codes}; -9 is mostly a lack of memory: use fewer environments)"
            if ended
            else f"stands still (process {stopped[0]} was stopped by a signal)"
        )
        end_processes(self._workers)
        raise RuntimeError(
            f"A worker of the collector {reason}. The last checkpoint is whole: continue with "
            "resume=."
        )

    def kill(self) -> None:
        """End the workers at once, whatever they are at; those on other machines as they end."""
        if getattr(self._workers, "procs", None):
            end_processes(self._workers)
        else:
            self.shutdown()

    def shutdown(self) -> None:
        """End the workers, if there are any."""
        if self._workers is not None and not getattr(self._workers, "closed", False):
            self._workers.shutdown()


def _begin(call: Callable[[], Any]) -> Future[Any]:
    """Begin a call in a thread that does not keep Python from ending."""
    asked: Future[Any] = Future()

    def run() -> None:
        try:
            asked.set_result(call())
        except BaseException as error:  # also StopIteration
            asked.set_exception(error)

    Thread(target=run, daemon=True).start()
    return asked


class _ProcessCollector(MultiSyncCollector):
    """TorchRL's, known while it starts: its processes are what it may for ever wait for."""

    def __init__(self, known: Known, *args: Any, **options: Any) -> None:
        known(self)
        super().__init__(*args, **options)


def make_process_collector(
    env: EnvBase,
    make_env: MakeEnv,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    num_collectors: int,
    device: torch.device | str,
    ahead: bool = False,
) -> WorkerCollector:
    """Collect in processes of this machine.

    Args:
        env: The run's environment; its rows are shared out, itself it is not stepped.
        make_env: Makes an environment like it with fewer rows, in the worker.
        policy: Policy, whose weights are sent to the workers.
        frames_per_batch: Steps of all rows together in one batch, N·T.
        num_collectors: Number of processes, W, that divides N.
        device: Device of policy and batches.
        ahead: Whether every batch is collected while the one before is learned from: the cores
            have more to do, and a batch is of the policy before the last update.

    Raises:
        ValueError: If N is not a multiple of W, or ``frames_per_batch`` of N, or the policy has a
            memory and is to collect ahead.
    """
    check_shares(env, num_collectors, frames_per_batch)
    # the weights of a policy lie where the workers read them, also while they step
    is_present = policy, lambda: None, None
    acting, catch_up, refresh = behind(policy, env.action_keys) if ahead else is_present

    def start(known: Known) -> None:
        catch_up()  # since it was built, the policy may have got the weights of a checkpoint
        shares = share_rows(env, make_env, num_collectors)
        with starting_processes():
            _ProcessCollector(
                known,
                shares,
                acting,
                frames_per_batch=frames_per_batch,
                total_frames=-1,
                policy_device="cpu",
                env_device="cpu",
                storing_device="cpu",
                cat_results=0,
                use_buffers=True,
                auto_register_policy_transforms=False,
            )

    return WorkerCollector(start, env.batch_size.numel(), torch.device(device), refresh)


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

    def start(known: Known) -> None:
        known(
            RayCollector(
                share_rows(env, make_env, num_collectors),
                policy,
                frames_per_batch=frames_per_batch,
                total_frames=sys.maxsize,
                sync=True,
                ray_init_config=ray_init,
                remote_configs=resources,
                num_collectors=num_collectors,
            )
        )

    return WorkerCollector(start, env.batch_size.numel(), torch.device(device))
