"""Environments of Gymnasium in several processes, each of which steps several of them.

Gymnasium's `AsyncVectorEnv` needs one process, with an interpreter, per environment.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import CloudpickleWrapper, batch_space

from safe_rl.processes import leave_signals_to_parent, starting_processes

SECONDS_TO_END = 5.0


class ProcessVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N environments in W processes, with array observations; ended ones are reset by a mask.

    A copy (`copy`, `pickle`) has processes of its own, and starts from the last seed.

    Args:
        make: Makes one environment, in a process of its own.
        num_envs: N.
        workers: W, at most N.
        info_keys: Numbers that are copied from `info`; 0 for processes that report none. Of other
            entries only the names are passed on.
        seed: What the first reset is seeded with; None leaves that to the caller.

    Raises:
        RuntimeError: If an environment fails; the message is that of its process.

    Examples:
        >>> from functools import partial
        >>> make = partial(gymnasium.make, "Pendulum-v1")
        >>> envs = ProcessVectorEnv(make, num_envs=3, workers=2, info_keys=[])
        >>> envs.reset(seed=0)[0].shape
        (3, 3)
        >>> envs.close()
    """

    def __init__(
        self,
        make: Callable[[], gymnasium.Env],
        num_envs: int,
        workers: int,
        info_keys: Sequence[str],
        seed: int | Sequence[int] | None = None,
    ) -> None:
        shares = [len(share) for share in np.array_split(np.arange(num_envs), workers)]
        self._bounds = np.cumsum(shares)[:-1]
        self._info_keys = list(info_keys)
        self._make, self._seed = make, seed
        self._workers: list[tuple[Any, Connection]] = []
        # Forked processes could inherit locks that a thread of torch's holds.
        context = get_context("spawn")
        with starting_processes():
            for number in shares:
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=_serve, args=(theirs, CloudpickleWrapper(make), number), daemon=True
                )
                process.start()
                theirs.close()
                self._workers.append((process, ours))
        spaces = self._receive()[0]
        self.single_observation_space, self.single_action_space, metadata, self.render_mode = spaces
        self.autoreset_mode = AutoresetMode.DISABLED
        self.metadata = {**metadata, "autoreset_mode": self.autoreset_mode}
        self.num_envs = num_envs
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._observation: np.ndarray = np.stack(
            [self.single_observation_space.sample()] * num_envs
        )
        if seed is not None:
            self.reset(seed=seed)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes, everywhere or where `options["reset_mask"]` [N] says."""
        self._seed = self._seed if seed is None else seed
        if isinstance(seed, int):
            seed = [seed + row for row in range(self.num_envs)]
        others = dict(options or {})
        mask = others.pop("reset_mask", np.ones(self.num_envs, dtype=bool))
        seeds = np.array_split(np.array(seed, dtype=object), self._bounds) if seed else []
        for i, part in enumerate(masks := np.split(mask, self._bounds)):
            if part.any():
                share = seeds[i].tolist() if seeds else None
                self._send(i, "reset", seed=share, options={**others, "reset_mask": part})
        asked = [i for i, part in enumerate(masks) if part.any()]
        parts = np.split(self._observation, self._bounds)  # views
        for i, (observation, _) in zip(asked, self._receive(asked), strict=True):
            parts[i][:] = observation
        return self._observation.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action [N, A] in every environment."""
        for i, part in enumerate(np.split(np.asarray(actions), self._bounds)):
            self._send(i, "step", part)
        *arrays, infos = zip(*self._receive(), strict=True)
        observation, reward, terminated, truncated = map(np.concatenate, arrays)
        self._observation[:] = observation
        sizes = [len(rewards) for rewards in arrays[1]]
        reported: dict[str, Any] = {name: None for info in infos for name in info}
        reported |= {
            key: np.concatenate(
                [info.get(key, np.zeros(size)) for info, size in zip(infos, sizes, strict=True)]
            )
            for key in self._info_keys
            if key in reported
        }
        return observation, reward, terminated, truncated, reported

    def render(self) -> tuple[Any, ...]:
        """Return a frame of every environment."""
        for i in range(len(self._workers)):
            self._send(i, "render")
        return tuple(frame for frames in self._receive() for frame in frames)

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        for process, connection in self._workers:
            connection.close()
            process.join(SECONDS_TO_END)
            if process.is_alive():
                process.kill()
        self._workers = []

    def __reduce__(self) -> tuple[Any, ...]:
        make, workers = CloudpickleWrapper(self._make), len(self._workers)
        return ProcessVectorEnv, (make, self.num_envs, workers, self._info_keys, self._seed)

    def _send(self, worker: int, method: str, *args: Any, **kwargs: Any) -> None:
        with suppress(BrokenPipeError):  # a dead process is reported when its answer is read
            self._workers[worker][1].send((method, args, kwargs))

    def _receive(self, workers: Sequence[int] | None = None) -> list[Any]:
        answers = []
        for i in range(len(self._workers)) if workers is None else workers:
            process, connection = self._workers[i]
            try:
                answer, failure = connection.recv()
            except (EOFError, ConnectionError):
                process.join(SECONDS_TO_END)
                raise RuntimeError(
                    f"A process of the environments has died (exit code {process.exitcode})."
                ) from None
            if failure is not None:
                raise RuntimeError(f"An environment failed in its process:\n{failure}")
            answers.append(answer)
        return answers


def _serve(connection: Connection, make: CloudpickleWrapper, number: int) -> None:
    """Step this process's environments as the parent asks, until it closes the connection."""
    leave_signals_to_parent()
    worlds: SyncVectorEnv | None = None
    try:
        worlds = SyncVectorEnv([make] * number, autoreset_mode=AutoresetMode.DISABLED)
        spaces = worlds.single_observation_space, worlds.single_action_space
        connection.send(((*spaces, worlds.envs[0].metadata, worlds.render_mode), None))
        while True:
            method, args, kwargs = connection.recv()
            connection.send((getattr(worlds, method)(*args, **kwargs), None))
    except (EOFError, ConnectionError):
        pass  # the parent has closed the connection, or has ended
    except Exception:
        connection.send((None, traceback.format_exc()))
    finally:
        if worlds is not None:
            worlds.close()
