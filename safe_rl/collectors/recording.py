"""Transitions of a run on disk: written batch by batch, and read back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

__all__ = ["Recording", "read_recording"]

# of a step and of what follows it; what a policy writes besides is not recorded
_FLAGS = ("done", "terminated", "truncated")


class Recording:
    """A folder with the transitions of a run, one memory-mapped TensorDict per batch [N, T].

    Args:
        folder: Where they go; made if it does not exist.
        cost_keys: Costs below ``next`` that are recorded.

    Raises:
        KeyError: When a batch is written that lacks one of the entries.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> done = torch.tensor([[[False], [True], [False]]])
        >>> following = {
        ...     "observation": torch.ones(1, 3, 2), "reward": torch.ones(1, 3, 1),
        ...     "cost": torch.ones(1, 3, 1), "done": done, "terminated": done, "truncated": ~done,
        ... }
        >>> batch = TensorDict(
        ...     observation=torch.zeros(1, 3, 2), action=torch.zeros(1, 3, 1), next=following,
        ...     batch_size=[1, 3],
        ... )
        >>> recording = Recording(folder, ["cost"])
        >>> recording.write(0, batch)
        >>> recording.write(1, batch)
        >>> read_recording(folder).shape
        torch.Size([1, 6])
    """

    def __init__(self, folder: Path | str, cost_keys: Sequence[str]) -> None:
        self.folder = Path(folder)
        following = ("observation", "reward", *cost_keys, *_FLAGS)
        self._keys = ["observation", "action", *(("next", key) for key in following)]

    def write(self, number: int, batch: TensorDictBase) -> None:
        """Write a batch [N, T] under its number; one that is there already is replaced."""
        piece = batch.select(*self._keys).cpu()
        piece.memmap(str(self.folder / f"{number:08d}"), copy_existing=True)


def read_recording(folder: Path | str) -> TensorDict:
    """Transitions [N, T] of a folder in order of time, in main memory.

    Raises:
        FileNotFoundError: If there are none.
    """
    pieces = sorted(path for path in Path(folder).glob("[0-9]*") if path.is_dir())
    if not pieces:
        raise FileNotFoundError(f"{folder} holds no transitions: is it the folder of a recording?")
    return torch.cat([TensorDict.load_memmap(str(path)).clone() for path in pieces], -1)
