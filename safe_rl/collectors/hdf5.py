"""Transitions from HDF5 files: flat arrays as DSRL has them, and episodes as Minari has them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict

from safe_rl.extras import import_extra

__all__ = ["read_hdf5"]

Arrays = dict[NestedKey, np.ndarray]

# DSRL's (Liu et al. 2024), which are those of D4RL, and `costs`
_FLAT: dict[NestedKey, str] = {
    "observation": "observations",
    "action": "actions",
    ("next", "reward"): "rewards",
    ("next", "cost"): "costs",
    ("next", "terminated"): "terminals",
    ("next", "truncated"): "timeouts",
}
# of each of Minari's episodes; costs are among the `infos`
_OF_AN_EPISODE: dict[NestedKey, str] = {
    "observation": "observations",
    "action": "actions",
    ("next", "reward"): "rewards",
    ("next", "terminated"): "terminations",
    ("next", "truncated"): "truncations",
}
_EPISODE = "episode_"
_FLAGS = (("next", "terminated"), ("next", "truncated"))


def read_hdf5(path: Path | str) -> TensorDict:
    """Transitions [1, M] of an HDF5 file, one episode after the other; needs the extra `hdf5`.

    Files are those of

    - DSRL and D4RL: flat arrays over all episodes, ``observations``, ``actions``, ``rewards``,
      ``costs``, ``terminals``, ``timeouts``, and ``next_observations``. Without the last, what
      follows a step is the observation of the next one, and that of the step itself where an
      episode ends;
    - Minari: a group ``episode_<i>`` for each episode, with ``observations`` (one more than steps),
      ``actions``, ``rewards``, ``terminations``, ``truncations``, and ``infos`` with ``cost`` and
      any ``cost_<kind>``. An episode that was cut off counts as truncated.

    Raises:
        ValueError: If the file is no HDF5 file, or an array is missing; the message names those
            that are there.
        ModuleNotFoundError: If h5py is not installed.
    """
    h5py = import_extra("h5py", "hdf5")
    if not h5py.is_hdf5(path):
        raise ValueError(f"{path} is neither the folder of a recording nor an HDF5 file.")
    with h5py.File(path, "r") as file:
        names = [name for name in file if name.startswith(_EPISODE)]
        if names:
            names.sort(key=lambda name: int(name.removeprefix(_EPISODE)))
            episodes = [_read_episode(path, file[name]) for name in names]
            arrays = {key: np.concatenate([e[key] for e in episodes]) for key in episodes[0]}
        else:
            arrays = _read_flat(path, file)
    steps = TensorDict(batch_size=[1, len(arrays["action"])])
    for key, column in _columns(arrays):
        steps[key] = column
    steps["next", "done"] = steps["next", "terminated"] | steps["next", "truncated"]
    return steps


def _read_flat(path: Path | str, file: Any) -> Arrays:
    arrays = _arrays(path, file, _FLAT)
    if "next_observations" in file:
        following = file["next_observations"][:]
    else:
        here = arrays["observation"]
        ends = arrays["next", "terminated"] | arrays["next", "truncated"]
        ends = np.append(ends[:-1], True).reshape(-1, *[1] * (here.ndim - 1))
        following = np.where(ends, here, np.roll(here, -1, 0))
    return {**arrays, ("next", "observation"): following}


def _read_episode(path: Path | str, group: Any) -> Arrays:
    arrays = _arrays(path, group, _OF_AN_EPISODE)
    observed, number = arrays["observation"], len(arrays["action"])
    infos = group.get("infos", {})
    # infos of the reset come first, if they were stored
    costs = {("next", name): infos[name][:][-number:] for name in infos if name.startswith("cost")}
    if ("next", "cost") not in costs:
        raise _lacking(path, ["infos/cost"], [f"infos/{name}" for name in infos] or list(group))
    arrays["next", "truncated"][-1] |= not arrays["next", "terminated"][-1]
    here, following = observed[:number], observed[1 : number + 1]
    return {**arrays, **costs, "observation": here, ("next", "observation"): following}


def _arrays(path: Path | str, group: Any, names: Mapping[NestedKey, str]) -> Arrays:
    found = [name for name in group if hasattr(group[name], "shape")]
    if missing := sorted(set(names.values()) - set(found)):
        raise _lacking(path, missing, found)
    return {
        key: group[name][:].astype(bool) if key in _FLAGS else group[name][:]
        for key, name in names.items()
    }


def _lacking(path: Path | str, missing: Sequence[str], found: Sequence[str]) -> ValueError:
    return ValueError(
        f"{path} has no {', '.join(missing)}: transitions are read from files like those of DSRL "
        f"or Minari. What it has: {', '.join(sorted(found)) or 'nothing'}."
    )


def _columns(arrays: Arrays) -> Iterator[tuple[NestedKey, torch.Tensor]]:
    """Tensors [1, M, n], numbers as float32 and flags as bool."""
    for key, array in arrays.items():
        column = torch.from_numpy(array.reshape(len(array), -1)).unsqueeze(0)
        yield key, column if key in _FLAGS else column.float()
