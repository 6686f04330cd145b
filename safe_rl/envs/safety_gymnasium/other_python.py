"""Environments of Safety-Gymnasium in processes of another Python, which has the package.

It is named by the environment variable SAFETY_GYMNASIUM_PYTHON.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from safe_rl.envs.costs import COST
from safe_rl.envs.safety_gymnasium import serve
from safe_rl.processes import starting_processes

__all__ = ["ServedVectorEnv", "Server", "open_server"]

SECONDS_TO_END = 5.0


class Server:
    """A process that serves environments, and the messages to it.

    Args:
        python: Path of an interpreter in which `safety_gymnasium` can be imported.
    """

    def __init__(self, python: str) -> None:
        clean = {key: value for key, value in os.environ.items() if key != "PYTHONSTARTUP"}
        # signals wait in it for ever: it ends when this process closes its pipe, or is no more
        with starting_processes():
            self._process = subprocess.Popen(
                [python, "-W", "ignore", str(Path(serve.__file__).resolve())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,  # what fails comes as an answer
                env=clean,
            )

    def ask(self, method: str, fields: Mapping[str, Any] | None = None, **arrays: Any) -> None:
        """Send a request; `answer` waits for what comes of it."""
        serve.send(
            cast(BinaryIO, self._process.stdin), {"method": method, **(fields or {})}, **arrays
        )

    def answer(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Wait for the answer to the last request.

        Raises:
            RuntimeError: if it failed there, or the process has ended.
        """
        header, arrays = serve.receive(cast(BinaryIO, self._process.stdout))
        if header is None:
            code = self._process.wait(SECONDS_TO_END)
            raise RuntimeError(f"The process of Safety-Gymnasium has ended (exit code {code}).")
        if "failure" in header:
            raise RuntimeError(header["failure"])
        return header["answer"], arrays

    def close(self) -> None:
        """End the process."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        try:
            self._process.wait(SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def open_server(
    python: str, env_id: str, num_envs: int, num_steps: int | None, kwargs: Mapping[str, Any]
) -> tuple[Server, dict[str, Any]]:
    """Start a process with so many environments; returns it and what it says of them.

    Raises:
        RuntimeError: if they cannot be made; the message is that of the process.
    """
    server = Server(python)
    fields = {"id": env_id, "num_envs": num_envs, "num_steps": num_steps, "kwargs": dict(kwargs)}
    try:
        server.ask("open", fields)
        said, arrays = server.answer()
    except BaseException:
        server.close()
        raise
    return server, {**said, **arrays}


class ServedVectorEnv(VectorEnv):
    """N environments in W processes of another Python; ended ones are reset by a mask.

    One float32 vector is observed.

    Args:
        start: starts a process with so many environments, and returns what it says of them.
        num_envs: N.
        workers: W, at most N.
        kinds: kinds of costs that are taken over from `info`.
    """

    def __init__(
        self,
        start: Callable[[int], tuple[Server, dict[str, Any]]],
        num_envs: int,
        workers: int,
        kinds: Sequence[str],
    ) -> None:
        shares = [len(share) for share in np.array_split(np.arange(num_envs), workers)]
        self._bounds, self._kinds = np.cumsum(shares)[:-1], list(kinds)
        self._servers: list[Server] = []
        for number in shares:
            server, said = start(number)
            self._servers.append(server)
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (said["size"],))
        self.single_action_space = (
            gymnasium.spaces.Discrete(said["choices"])
            if "choices" in said
            else gymnasium.spaces.Box(said["low"], said["high"], dtype=np.float32)
        )
        self.num_envs = num_envs
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = None
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": ["rgb_array"]}
        self._observation = np.zeros((num_envs, said["size"]), np.float32)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes, everywhere or where `options["reset_mask"]` [N] says."""
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        if isinstance(seed, int):
            seed = [seed + row for row in range(self.num_envs)]
        every = [None] * self.num_envs if seed is None else list(seed)
        seeds = np.split(np.array(every, dtype=object), self._bounds)
        parts = np.split(mask, self._bounds)
        for server, share, part in zip(self._servers, seeds, parts, strict=True):
            server.ask("reset", {"seeds": share.tolist(), "kinds": self._kinds}, mask=part)
        self._observation[mask] = np.concatenate(
            [found["observation"] for found in self._answers()]
        )
        return self._observation.copy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action [N, A] in every environment."""
        for server, part in zip(
            self._servers, np.split(np.asarray(actions), self._bounds), strict=True
        ):
            server.ask("step", actions=part)
        answers = self._answers()
        joined = {key: np.concatenate([found[key] for found in answers]) for key in answers[0]}
        self._observation = joined["observation"]
        costs = {COST: joined["cost"], **dict(zip(self._kinds, joined["kinds"].T, strict=True))}
        ends = joined["terminated"], joined["truncated"]
        return self._observation.copy(), joined["reward"], *ends, costs

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a frame of every environment."""
        if self.render_mode is None:
            return None
        for server in self._servers:
            server.ask("render")
        return tuple(frame for found in self._answers() for frame in found["frames"])

    def close_extras(self, **kwargs: Any) -> None:
        """End the processes."""
        for server in self._servers:
            server.close()
        self._servers = []

    def _answers(self) -> list[dict[str, np.ndarray]]:
        return [server.answer()[1] for server in self._servers]
