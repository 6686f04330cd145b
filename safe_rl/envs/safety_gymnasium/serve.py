"""Serves environments of Safety-Gymnasium to another process, in whatever Python they need.

A script, run by the Python that has the package: `python serve.py`. Of ours it imports nothing, and
it does with Python 3.8. Messages are a line of JSON and the arrays that it names, because pickles
of different versions of NumPy do not read one another.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from importlib import import_module
from typing import Any, BinaryIO

import numpy as np

MODULES = "SAFETY_GYMNASIUM_IMPORT"
"""Environment variable with modules that register more of them, by commas."""


def send(stream: BinaryIO, header: dict[str, Any], **arrays: Any) -> None:
    """Write a message: a header of plain values, and arrays."""
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    shapes = {name: [array.dtype.str, array.shape] for name, array in arrays.items()}
    stream.write(json.dumps([header, shapes]).encode() + b"\n")
    for array in arrays.values():
        stream.write(array.tobytes())
    stream.flush()


def receive(stream: BinaryIO) -> tuple[dict[str, Any] | None, dict[str, np.ndarray]]:
    """Read a message: its header and its arrays; None where the other side has gone."""
    line = stream.readline()
    if not line:
        return None, {}
    header, shapes = json.loads(line)
    arrays = {}
    for name, (dtype, shape) in shapes.items():
        size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        arrays[name] = np.frombuffer(stream.read(size), dtype).reshape(shape).copy()
    return header, arrays


class Served:
    """Environments of an id, stepped one after the other; none is reset unless it is asked for.

    Args:
        header: `id`, `num_envs`, `num_steps` (None leaves it to the id) and `kwargs`.
    """

    def __init__(self, header: dict[str, Any]) -> None:
        import safety_gymnasium
        from gymnasium import spaces

        for module in filter(None, os.environ.get(MODULES, "").split(",")):
            import_module(module)
        self._spaces = spaces
        kwargs = dict(header["kwargs"])
        if header["num_steps"] is not None:
            kwargs["max_episode_steps"] = header["num_steps"]
        make = safety_gymnasium.make
        self._envs = [make(header["id"], **kwargs) for _ in range(header["num_envs"])]
        self._kinds: list[str] = []
        self._num_steps = header["num_steps"] or episode_length(self._envs[0])

    def describe(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Spaces, length of episodes and kinds of costs; these are found by taking a step."""
        env, actions = self._envs[0], self._envs[0].action_space
        env.reset(seed=0)
        *_, info = env.step(actions.sample())
        found = [key for key in info if key.startswith("cost_") and key != "cost_sum"]
        header = {"num_steps": self._num_steps, "kinds": found}
        header["size"] = int(self._spaces.flatdim(env.observation_space))
        if hasattr(actions, "n"):
            return {**header, "choices": int(actions.n)}, {}
        return header, {"low": np.float32(actions.low), "high": np.float32(actions.high)}

    def reset(
        self, seeds: list[int | None], kinds: list[str], mask: np.ndarray
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start new episodes where the mask [n] says; observations of these."""
        self._kinds = kinds
        seen = [self._envs[i].reset(seed=seeds[i])[0] for i in np.flatnonzero(mask)]
        return {}, {"observation": self._flat(seen)}

    def step(self, actions: np.ndarray) -> tuple[dict[str, Any], dict[str, Any]]:
        """Take an action in every environment."""
        rows = [env.step(actions[i]) for i, env in enumerate(self._envs)]
        kinds = [[float(row[5].get(key, 0.0)) for key in self._kinds] for row in rows]
        return {}, {
            "observation": self._flat([row[0] for row in rows]),
            "reward": np.array([row[1] for row in rows], np.float64),
            "cost": np.array([row[2] for row in rows], np.float64),
            "kinds": np.array(kinds, np.float64).reshape(len(rows), len(self._kinds)),
            "terminated": np.array([row[3] for row in rows], bool),
            "truncated": np.array([row[4] for row in rows], bool),
        }

    def render(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return a frame of every environment, uint8 [n, height, width, 3]."""
        return {}, {"frames": np.stack([env.render() for env in self._envs])}

    def _flat(self, observations: list[Any]) -> np.ndarray:
        space = self._envs[0].observation_space
        rows: list[Any] = [self._spaces.flatten(space, seen) for seen in observations]
        return np.array(rows, np.float32).reshape(len(rows), self._spaces.flatdim(space))


def episode_length(env: Any) -> int | None:
    """Return what is registered, or what the innermost environment says of its episodes."""
    spec = getattr(env, "spec", None)
    return getattr(spec, "max_episode_steps", None) or getattr(env.unwrapped, "num_steps", None)


def main() -> None:
    """Answer requests from the standard input until it ends."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    sys.path[:] = [path for path in sys.path if path != os.path.dirname(os.path.abspath(__file__))]
    served = None
    while True:
        header, arrays = receive(requests)
        if header is None:
            return
        try:
            method = header.pop("method")
            if method == "open":
                served = Served(header)
                answer, results = served.describe()
            else:
                answer, results = getattr(served, method)(**header, **arrays)
            send(answers, {"answer": answer}, **results)
        except Exception as error:
            words = f"{type(error).__name__}: {error}"
            send(answers, {"failure": words, "traceback": traceback.format_exc()})


if __name__ == "__main__":
    main()
