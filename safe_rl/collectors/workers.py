"""Collection by workers, on this machine or on others, and the rows that each of them steps.

Every worker has the seeds that its rows have in a single process, so that a run meets the same kind
of episodes however many workers it has.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from functools import partial
from multiprocessing import parent_process
from multiprocessing.queues import Queue
from threading import Thread
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from safe_rl.processes import leave_signals_to_parent

__all__ = ["Known", "MakeEnv", "Makers", "WorkerCollector", "kill_workers", "split_rows"]


class MakeEnv(Protocol):
    """Makes the run's environment with another number of rows; workers call it."""

    def __call__(self, *, num_envs: int) -> EnvBase:
        """Make an environment of ``num_envs`` rows."""
        ...


Makers = list[Callable[[], EnvBase]]


def split_rows(env: EnvBase, make_env: MakeEnv, num_collectors: int) -> Makers:
    """Functions that make every worker's environment, with its share of the rows of ``env``.

    Where ``get_state`` of the environment is not None, workers continue its rows from their next
    reset. Otherwise every worker makes a new environment with a seed of its own, whose schedules
    continue after the ``steps_before`` of ``env``.
    """
    states: list[TensorDictBase | None]
    if env.get_state() is None:
        states = [None] * num_collectors
    else:
        env.reset()
        states = list(env.get_state().chunk(num_collectors))
    seeds = torch.randint(2**62, (num_collectors,)).tolist()
    rows = env.batch_size.numel() // num_collectors
    before = env.steps_before
    return [
        partial(_make_rows, make_env, rows, state, seed, before)
        for state, seed in zip(states, seeds, strict=True)
    ]


def _make_rows(
    make_env: MakeEnv, num_envs: int, state: TensorDictBase | None, seed: int, steps_before: int
) -> EnvBase:
    # for the policy's noise: every worker needs its own
    torch.manual_seed(seed)
    if parent_process() is not None:
        leave_signals_to_parent()
    env = make_env(num_envs=num_envs)
    if state is not None:
        env.set_state(state)
    else:
        env.set_seed(seed % 2**31)
        env.continue_from(steps_before)
    # again: an environment that is seeded may have seeded all that torch draws
    torch.manual_seed(seed)
    return env


Known = Callable[["KnownWorkers"], None]
"""Stores a collector of TorchRL's."""


class KnownWorkers:
    """Defaults of what TorchRL's collectors of workers have once they are running.

    A base of collectors, before TorchRL's class: they are known while they still start.

    Attributes:
        procs: Processes on this machine; none where workers are actors elsewhere.
        closed: Whether there is nothing to shut down.
    """

    procs: Sequence[Any] = ()
    closed: bool = True
    _weight_sync_schemes: Mapping[str, Any] | None = None


_MOST_LOOKS = 20
"""Seconds after the end of a worker in which TorchRL may still raise its error."""
_EXPLAINED = {0, 1, -signal.SIGKILL}
"""Exit codes of workers whose error may follow: TorchRL kills all of them before it raises it."""


class WorkerError(RuntimeError):
    """A worker has died."""


class WorkerCollector:
    """Batches [N, T] of the present policy, collected by workers in step with each other.

    The workers get the policy's weights before every batch but the first, with which they start.

    Args:
        start: Starts TorchRL's collector, whose batches are [W, n, T] or [N, T], with the functions
            that make its environments, and hands it, as soon as it has processes, to a function.
        env: The run's environment; its rows are shared out, itself it is not stepped.
        make_env: Makes an environment like it with fewer rows, in the worker.
        num_collectors: Number of workers W.
        frames_per_batch: Steps of all rows together in one batch, N·T.
        device: Device of the batches.

    Raises:
        ValueError: If N is not a multiple of W, or ``frames_per_batch`` of N.
    """

    def __init__(
        self,
        start: Callable[[Known, Makers], Any],
        env: EnvBase,
        make_env: MakeEnv,
        num_collectors: int,
        frames_per_batch: int,
        device: torch.device | str,
    ) -> None:
        self._num_envs = env.batch_size.numel()
        if (
            num_collectors < 1
            or self._num_envs % num_collectors
            or frames_per_batch % self._num_envs
        ):
            raise ValueError(
                f"{num_collectors} collectors cannot share {self._num_envs} environments and "
                f"batches of {frames_per_batch} frames equally: num_envs must be a multiple of "
                "num_collectors, and frames_per_batch of num_envs."
            )
        self.storing_device = torch.device(device)
        self._start = lambda: start(self._known, split_rows(env, make_env, num_collectors))
        self._workers: Any = KnownWorkers()
        self._looks = 0

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Start the workers and collect without end.

        Raises:
            WorkerError: If a worker has died.
        """
        self._wait_for(_begin(self._start))
        batches = iter(self._workers)
        asked = _begin(lambda: next(batches))
        while True:
            yield self._wait_for(asked).reshape(self._num_envs, -1).to(self.storing_device)
            self._wait_for(_begin(self._workers.update_policy_weights_))
            asked = _begin(lambda: next(batches))

    def _known(self, workers: Any) -> None:
        """Store TorchRL's collector, which is passed while it still starts its processes."""
        self._workers = workers

    def _wait_for(self, asked: Future[Any]) -> Any:
        """The result of a call that would wait without end for a worker that has died."""
        while not wait([asked], timeout=1.0).done:
            self._check_workers()
        failure = asked.exception()
        if failure is None:
            return asked.result()
        if isinstance(failure, (EOFError, OSError)):  # the pipe of a process that has ended
            self._looks = _MOST_LOOKS
        self._check_workers()
        kill_workers(self._workers)
        raise failure

    def _check_workers(self) -> None:
        """Raise, and end all processes, if one has ended for some time."""
        processes = [p for p in self._workers.procs if not p._closed]
        ended = [p.exitcode for p in processes if p.exitcode is not None]
        self._looks = self._looks + 1 if ended else 0
        if not set(ended) - _EXPLAINED and self._looks <= _MOST_LOOKS:
            return
        codes = ", ".join(map(str, ended))
        kill_workers(self._workers)
        raise WorkerError(
            f"A worker of the collector has died (exit code {codes}; -9 is mostly a lack of "
            "memory: use fewer environments). The last checkpoint is whole: continue with resume=."
        )

    def kill(self) -> None:
        """Kill the workers; those on other machines are shut down."""
        if self._workers.procs:
            kill_workers(self._workers)
        else:
            self.shutdown()

    def shutdown(self) -> None:
        """End the workers, if there are any."""
        if not self._workers.closed:
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


def kill_workers(collector: Any) -> None:
    """Kill the processes of a collector, and release what this process would wait for at exit.

    Args:
        collector: TorchRL's, started or not.
    """
    processes = [p for p in collector.procs if not p._closed]
    for process in processes:
        process.kill()
    for process in processes:
        process.join(timeout=5.0)
    # Python would wait at exit for weights sent to dead processes, and for a thread of the schemes
    schemes = (collector._weight_sync_schemes or {}).values()
    for holder in (collector, *schemes):
        for queue in _queues(vars(holder).values()):
            queue.cancel_join_thread()
    for scheme in schemes:
        scheme.shutdown()
    collector.closed = True


def _queues(values: Iterable[Any]) -> Iterator[Queue]:
    for value in values:
        if isinstance(value, Queue):
            yield value
        elif isinstance(value, dict):
            yield from _queues(value.values())
