"""The rows of a batched environment that each worker steps.

Every worker has the seeds that its rows have in a single process, so that a run meets the same kind
of episodes however it is spread.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from multiprocessing import parent_process
from typing import Protocol

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from safe_rl.processes import leave_signals_to_parent

__all__ = ["MakeEnv", "check_rows", "split_rows"]


class MakeEnv(Protocol):
    """Makes the run's environment with another number of rows; workers call it."""

    def __call__(self, *, num_envs: int) -> EnvBase:
        """Make an environment of ``num_envs`` rows."""
        ...


def check_rows(env: EnvBase, num_collectors: int, frames_per_batch: int) -> None:
    """Refuse numbers that cannot be shared equally."""
    num_envs = env.batch_size.numel()
    if num_collectors < 1 or num_envs % num_collectors or frames_per_batch % num_envs:
        raise ValueError(
            f"{num_collectors} collectors cannot share {num_envs} environments and batches of "
            f"{frames_per_batch} frames equally: num_envs must be a multiple of num_collectors, "
            "and frames_per_batch of num_envs."
        )


def split_rows(env: EnvBase, make_env: MakeEnv, num_collectors: int) -> list[Callable[[], EnvBase]]:
    """Functions that make every worker's environment, with its share of the rows of ``env``.

    An environment whose ``get_state`` is not None has its rows continued by the workers, from their
    next reset; any other one is made anew, and seeded apart from the other workers'. Its schedules
    go on after the ``steps_before`` of ``env``.
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
    # of the policy's noise: every worker needs its own
    torch.manual_seed(seed)
    if parent_process() is not None:
        # which ends the run, with a checkpoint
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
