"""State of the training loop: counters, random numbers, environments, a request to stop."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from safe_rl.resumable import Resumable


@dataclass
class Progress(Resumable):
    """Counters of a run: epochs, environment steps, seconds of training."""

    state_names = ("epoch", "steps", "seconds")
    epoch: int = 0
    steps: int = 0
    seconds: float = 0.0


class RandomGenerators(GlobalRNGState):
    """The global random generators, without those of accelerators that this machine lacks.

    A run may be continued on another machine, for example one without a GPU.
    """

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore the generators of the CPU, and of as many accelerators as there are."""
        state = dict(state_dict)
        for kind in ("cuda", "xpu", "mps"):
            count = getattr(torch, kind).device_count()
            saved = state.pop(f"torch_{kind}", None)
            if saved is not None and count:
                state[f"torch_{kind}"] = saved if kind == "mps" else saved[:count]
        super().load_state_dict(state)


def staggered_steps(env: EnvBase) -> Tensor | None:
    """Steps [N] at which first episodes start, so that later ones end at different times.

    Row i starts at i · longest / N, rounded down to a multiple of the steps per decision. None if
    the environment has no state with a ``step_count``.
    """
    state = env.get_state()
    if state is None or "step_count" not in state:
        return None
    num_envs, decision = env.batch_size.numel(), env.steps_per_decision
    steps = torch.arange(num_envs) * env.max_episode_steps // num_envs
    return steps // decision * decision


class EnvSnapshot:
    """The state of the environment, and its observation, at the start of the next epoch.

    Every epoch restores a snapshot, also in a run that is not resumed. The reason: restoring a
    state changes things that snapshots do not have (it wakes sleeping bodies). If only resumed runs
    did this, they would differ from uninterrupted runs.
    """

    def __init__(self, env: EnvBase, collector: Collector) -> None:
        self._env = env
        self._collector = collector
        self._snapshot: TensorDictBase = env.get_state()

    def take(self) -> None:
        """Take a snapshot and continue from it."""
        self._go_on_from(self._env.get_state())

    def stagger(self, steps: Tensor) -> None:
        """Start the rows at these steps [N] of their first episodes."""
        self._collector._carrier.update(self._env.add_steps(steps))
        self._snapshot = self._env.get_state()

    def state_dict(self) -> dict[str, Any]:
        """The last snapshot."""
        return self._snapshot.to_dict()

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore the environment, and let the collector continue from it."""
        saved = self._snapshot.from_dict(state_dict, batch_size=self._env.batch_size)
        # to the devices of the present state, where it has the entry
        moved = saved.apply(
            lambda new, old: new if old is None else new.to(old.device),
            self._snapshot,
            default=None,
        )
        self._go_on_from(moved)

    def _go_on_from(self, snapshot: TensorDictBase) -> None:
        self._snapshot = snapshot
        # the collector has no public way to start from a given state instead of a reset
        self._collector._carrier.update(self._env.set_state(snapshot))


@contextmanager
def catching_signals() -> Iterator[list[signal.Signals]]:
    """Yield a list that gets the first SIGINT (Ctrl-C), SIGTERM or SIGHUP; a second acts as usual.

    SIGHUP is sent when a terminal is closed; if it is already ignored, as with ``nohup``, it stays
    ignored. Signals can only be caught in the main thread; in others the list stays empty.
    """
    received: list[signal.Signals] = []
    with ExitStack() as before:  # restores the handlers

        def stop(number: int, frame: FrameType | None) -> None:
            received.append(signal.Signals(number))
            before.close()
            # not print(): the signal may have interrupted one; the terminal may be closed
            with suppress(OSError):
                os.write(2, b"\nStopping after this epoch. Once more stops at once.\n")

        if threading.current_thread() is threading.main_thread():
            # SIGINT is caught even if ignored, as in a shell's background job: kill -INT must work
            ignores_hangup = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            hangup = set() if ignores_hangup else {signal.SIGHUP}
            for number in {signal.SIGINT, signal.SIGTERM} | hangup:
                before.callback(signal.signal, number, signal.signal(number, stop))
        yield received
