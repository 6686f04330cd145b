"""Collection by workers on this machine or others, each with some rows of the environment.

Rows of workers have the same seeds as in a single process, so that a run meets the same kind of
episodes with any number of workers.
"""

from __future__ import annotations

import gc
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from functools import partial
from multiprocessing import active_children, connection, parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from threading import Thread
from traceback import clear_frames
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

MakeEnv = Callable[..., EnvBase]
"""Function of ``num_envs``, called in workers, that makes the run's environment with fewer rows."""
Makers = list[Callable[[], EnvBase]]


def split_rows(
    env: EnvBase, make_env: MakeEnv, num_collectors: int, first_steps: Tensor | None = None
) -> Makers:
    """Functions, one per worker, that make environments with parts of the rows of ``env``.

    Their first episodes begin at ``first_steps`` [N], by default at step 0.

    If the environment has a state that can be copied (``get_state``), workers continue its rows,
    from the next reset on. Otherwise every worker makes a new environment with its own seed. The
    schedules of the new environment continue after the ``steps_before`` of ``env``.
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
    firsts = [None] * num_collectors if first_steps is None else first_steps.split(rows)
    return [
        partial(_make_rows, make_env, rows, state, seed, before, first)
        for state, seed, first in zip(states, seeds, firsts, strict=True)
    ]


def _make_rows(
    make_env: MakeEnv,
    num_envs: int,
    state: TensorDictBase | None,
    seed: int,
    steps_before: int,
    first_steps: Tensor | None,
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
    env.first_steps = first_steps
    # again, because an environment may seed torch's global generator when it is seeded
    torch.manual_seed(seed)
    return env


class WorkerError(RuntimeError):
    """A worker has died."""


class WorkerCollector:
    """Collector of batches [N, T] of the present policy from synchronous workers.

    The workers start with the policy's weights, and get its new weights before every later batch.

    Args:
        start: Function that starts TorchRL's collector, whose batches are [W, n, T] or [N, T], from
            the list of functions that make the workers' environments.
        env: The run's environment. Its rows are divided among workers; it is not stepped itself.
        make_env: Function that makes such an environment with fewer rows, in a worker.
        num_collectors: Number of workers W.
        device: Device of the batches.

    Raises:
        ValueError: If N is not a multiple of W.
    """

    def __init__(
        self,
        start: Callable[[Makers], Any],
        env: EnvBase,
        make_env: MakeEnv,
        num_collectors: int,
        device: torch.device | str,
    ) -> None:
        self._num_envs = env.batch_size.numel()
        if self._num_envs % num_collectors:
            raise ValueError(
                f"{num_collectors} collectors cannot share {self._num_envs} environments equally: "
                "num_envs must be a multiple of num_collectors."
            )
        self.storing_device = torch.device(device)
        self._first_steps: Tensor | None = None
        self._start = lambda: start(split_rows(env, make_env, num_collectors, self._first_steps))
        self._workers: Any = None

    def stagger(self, steps: Tensor) -> None:
        """Start the rows at these steps [N] of their first episodes. Call it before collecting."""
        self._first_steps = steps

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Start the workers and collect without end.

        Raises:
            WorkerError: If a worker has died, or could not begin.
        """
        others = set(active_children())
        try:
            self._workers = self._ask(self._start)
        except BaseException as error:
            # When Python exits, it would wait for the workers that have started, and for the
            # objects that send weights to them, which the frames of the error keep alive.
            for process in set(active_children()) - others:
                process.kill()
            clear_frames(error.__traceback__)
            gc.collect()
            if "failed to initialize and closed" in str(error):
                raise WorkerError(
                    "A worker could not begin; what it says is above. In a script of yours, "
                    'train with workers only below `if __name__ == "__main__":`.'
                ) from error
            raise
        batches = iter(self._workers)
        while True:
            batch = self._ask(lambda: next(batches)).reshape(self._num_envs, -1)
            yield batch.to(self.storing_device)
            self._ask(self._workers.update_policy_weights_)

    def _ask(self, call: Callable[[], Any]) -> Any:
        """The result of a call; raises if a worker dies, for which the call would wait forever.

        The call runs in a daemon thread, which delays neither signals nor the exit of Python.
        """
        asked: Future[Any] = Future()

        def run() -> None:
            try:
                asked.set_result(call())
            except BaseException as error:  # also StopIteration
                asked.set_exception(error)

        Thread(target=run, daemon=True).start()
        while not wait([asked], timeout=1.0).done:
            self._check_workers()
        if asked.exception() is not None and self._processes:
            # a worker's death may be the cause, but its exit code may not be known yet
            connection.wait([process.sentinel for process in self._processes], timeout=5.0)
            self._check_workers()
        return asked.result()

    @property
    def _processes(self) -> list[BaseProcess]:
        """Worker processes on this machine that have not been closed."""
        return [p for p in getattr(self._workers, "procs", ()) if not p._closed]

    def _check_workers(self) -> None:
        """End all workers and raise if one has died; SIGTERM is how TorchRL ends them."""
        codes = {process.exitcode for process in self._processes}
        if not (died := codes - {None, 0, 128 + signal.SIGTERM}):
            return
        self.shutdown(timeout=0.0)
        reason = "what it printed is above"
        if -signal.SIGKILL in died:
            reason = "mostly for lack of memory: use fewer environments"
        raise WorkerError(
            f"A worker of the collector has died (exit code {', '.join(map(str, died))}, {reason})."
            " The last checkpoint is whole: continue with resume=."
        )

    def shutdown(self, timeout: float | None = None) -> None:
        """End the workers, if there are any; after ``timeout`` seconds by force."""
        workers, self._workers = self._workers, None
        if workers is not None:
            workers.shutdown(timeout=timeout)
            for scheme in (workers._weight_sync_schemes or {}).values():
                scheme.shutdown()


_LOOK = 1.0
"""Seconds between checks of the parent."""
_watching: set[int] = set()  # ids of this process and its ancestors that watch their parent


def end_with_parent(grace: float = 0.0, parent: int | None = None) -> None:
    """End this process when its parent has ended for any reason.

    Args:
        grace: Seconds that a run in this process has to write its checkpoint after SIGTERM.
        parent: The parent's process id; None: that of the present one.
    """
    if os.getpid() in _watching:
        return
    _watching.add(os.getpid())
    parent = os.getppid() if parent is None else parent

    def watch() -> None:
        # when the parent ends, this process gets another one
        while os.getppid() == parent:
            time.sleep(_LOOK)
        # not if a first SIGTERM has restored the default: a second one would end the run at once
        if grace and callable(signal.getsignal(signal.SIGTERM)):
            os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(grace)
        os._exit(1)

    Thread(target=watch, name="end with parent", daemon=True).start()


@contextmanager
def starting_processes() -> Iterator[None]:
    """Block SIGINT, SIGTERM and SIGHUP in processes that this thread starts within the block.

    These signals reach all processes of a run: by Ctrl-C, by the end of a terminal, or from the
    scheduler of a cluster. Only the first process should react to them, but they would end the
    others while these start. The others block them until `leave_signals_to_parent`.
    """
    # started later, together with the first process, the tracker would unblock the signals
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(
        signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    )
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_signals_to_parent() -> None:
    """Let this process end when its parent ends or sends SIGTERM, and ignore other signals.

    The other signals are SIGINT, SIGHUP, and SIGTERM from any other process. Call this function in
    the main thread of a process that was started within `starting_processes`. Where the
    system does not tell the sender of a signal (macOS), any SIGTERM ends the process.
    """
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    parent = os.getppid()
    end_with_parent()
    if not hasattr(signal, "sigwaitinfo"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        return
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})

    def wait() -> None:
        while signal.sigwaitinfo({signal.SIGTERM}).si_pid != parent:
            pass
        os._exit(128 + signal.SIGTERM)

    Thread(target=wait, name="wait for the parent's order", daemon=True).start()
