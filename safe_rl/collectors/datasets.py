"""Transitions on disk: written by a run, read back, or read from files of offline benchmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase

from safe_rl.extras import import_extra

__all__ = ["Recording", "read_hdf5", "read_recording", "safe_episodes"]

# of a step and of what follows it; what a policy writes besides is not recorded
_FLAGS = ("done", "terminated", "truncated")
# names in files of DSRL (Liu et al. 2024), which are those of D4RL, and `costs`
_HDF5: dict[NestedKey, str] = {
    "observation": "observations",
    "action": "actions",
    ("next", "observation"): "next_observations",
    ("next", "reward"): "rewards",
    ("next", "cost"): "costs",
    ("next", "terminated"): "terminals",
    ("next", "truncated"): "timeouts",
}


class Recording:
    """A folder with the transitions of a run, one memory-mapped TensorDict per batch [N, T].

    Args:
        folder: Where they go; made if it does not exist.
        cost_keys: Costs below ``next`` that are recorded.

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


def read_hdf5(path: Path | str) -> TensorDict:
    """Transitions [1, M] of an HDF5 file as DSRL and D4RL have them; needs the extra `hdf5`.

    The file holds flat arrays over all episodes, one after the other: ``observations``,
    ``next_observations``, ``actions``, ``rewards``, ``costs``, ``terminals``, ``timeouts``.

    Raises:
        KeyError: If an array is missing; the message names those that are there.
        ModuleNotFoundError: If h5py is not installed.
    """
    h5py = import_extra("h5py", "hdf5")
    with h5py.File(path, "r") as file:
        missing = sorted(set(_HDF5.values()) - set(file))
        if missing:
            raise KeyError(
                f"{path} has no {', '.join(missing)}: transitions are read from files like those "
                f"of DSRL. What it has: {', '.join(sorted(file))}."
            )
        arrays = {key: torch.from_numpy(file[name][:]) for key, name in _HDF5.items()}
    steps = TensorDict(batch_size=[1, len(arrays["action"])])
    for key, array in arrays.items():
        column = array.reshape(len(array), -1).unsqueeze(0)
        is_flag = key in (("next", "terminated"), ("next", "truncated"))
        steps[key] = column.bool() if is_flag else column.float()
    steps["next", "done"] = steps["next", "terminated"] | steps["next", "truncated"]
    return steps


def safe_episodes(steps: TensorDictBase, limits: Mapping[str, float]) -> TensorDictBase:
    """Steps [1, M] of the whole episodes that cost no more than limits allow, one after the other.

    Args:
        steps: Consecutive steps [N, T]; a row's last episode counts only if it is over.
        limits: Cost key -> undiscounted cost allowed per episode.

    Examples:
        >>> done = torch.tensor([[False, True, False, True, False]]).unsqueeze(-1)
        >>> cost = torch.tensor([[1.0, 1.0, 0.0, 1.0, 0.0]]).unsqueeze(-1)
        >>> steps = TensorDict(next={"done": done, "cost": cost}, batch_size=[1, 5])
        >>> safe_episodes(steps, {"cost": 1.0}).shape  # the second episode of three
        torch.Size([1, 2])
    """
    done = steps["next", "done"].squeeze(-1).long()
    episode = done.cumsum(-1) - done
    number = int(episode.max()) + 1
    is_kept = torch.zeros(done.shape[0], number).scatter_add_(1, episode, done.float()) > 0
    for key, limit in limits.items():
        cost = steps["next", key].squeeze(-1).double()
        total = torch.zeros(done.shape[0], number, dtype=torch.float64)
        is_kept = is_kept & (total.scatter_add_(1, episode, cost) <= limit)
    return steps.reshape(-1)[is_kept.gather(1, episode).reshape(-1)].unsqueeze(0)
