"""Transitions from disk: recordings, files of offline benchmarks, and the safe episodes of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase

from safe_rl.collectors.hdf5 import read_hdf5
from safe_rl.collectors.recording import PARTIAL, read_recording

__all__ = ["read_dataset", "safe_episodes"]


def read_dataset(path: Path | str) -> TensorDictBase:
    """Transitions [N, T] of the folder of a recording, or [1, M] of an HDF5 file.

    Raises:
        FileNotFoundError: If there is neither.
        ValueError: If the file is not as DSRL's or Minari's are.
        ModuleNotFoundError: If it is a file, and h5py is not installed.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"{path}: there is no such recording, and no such file.")
    return read_recording(path) if Path(path).is_dir() else read_hdf5(path)


def safe_episodes(steps: TensorDictBase, limits: Mapping[str, float]) -> TensorDictBase:
    """Steps [1, M] of the whole episodes that cost no more than limits allow, one after the other.

    Args:
        steps: Consecutive steps [N, T]; a row's last episode counts only if it is over, and none
            that is ``partial`` in a step, where there is such an entry.
        limits: Cost key -> undiscounted cost allowed per episode.

    Examples:
        >>> from tensordict import TensorDict
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
    if (partial := steps.get(PARTIAL, None)) is not None:
        parts = torch.zeros(done.shape[0], number)
        is_kept = is_kept & (parts.scatter_add_(1, episode, partial.squeeze(-1).float()) == 0)
    for key, limit in limits.items():
        cost = steps["next", key].squeeze(-1).double()
        total = torch.zeros(done.shape[0], number, dtype=torch.float64)
        is_kept = is_kept & (total.scatter_add_(1, episode, cost) <= limit)
    return steps.reshape(1, -1)[:, is_kept.gather(1, episode).reshape(-1)]
