"""Transitions from disk: recordings, HDF5 files of DSRL or Minari, and their safe episodes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from re import fullmatch, sub
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from safe_rl.collectors.recording import PARTIAL, read_interface, read_recording
from safe_rl.extras import import_extra
from safe_rl.files import printable

Arrays = dict[NestedKey, np.ndarray]

_NAMES: dict[NestedKey, str] = {
    "observation": "observations",
    "action": "actions",
    ("next", "reward"): "rewards",
}
# names of arrays in files of DSRL (Liu et al. 2024): those of D4RL, which have no `costs`
_FLAT = _NAMES | {
    ("next", "cost"): "costs",
    ("next", "terminated"): "terminals",
    ("next", "truncated"): "timeouts",
}
# names of arrays in each episode of a Minari file; costs are among its `infos`
_OF_AN_EPISODE = _NAMES | {
    ("next", "terminated"): "terminations",
    ("next", "truncated"): "truncations",
}
_FLAGS = (("next", "terminated"), ("next", "truncated"))
_MEMORY = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2  # for one array [bytes]
_ROUNDING = 1e-7  # of a limit: the relative rounding error of costs in single precision is lower


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


def read_columns(path: Path | str) -> dict[str, Any]:
    """What a dataset says of its columns and units: as ``interface`` of an environment, or less.

    An HDF5 file names the columns of its observations in the attribute ``observation_columns``,
    an array of texts at its root.

    Raises:
        ValueError: If it cannot be read.
        ModuleNotFoundError: If it is a file, and h5py is not installed.
    """
    if Path(path).is_dir():
        return read_interface(path)
    with open_hdf5(path) as file:
        names = file.attrs.get("observation_columns")
        if names is None:
            return {}
        texts = (n.decode() if isinstance(n, bytes) else str(n) for n in np.ravel(names))
        return {"columns": list(texts)}


# The order of Safety-Gymnasium 1.0, also in files of DSRL: the robot's sensors, velocities of
# joints before positions, then lidars of geoms, of free bodies and of moving ones; # is a number.
_SAFETY_GYMNASIUM = (
    *("accelerometer", "velocimeter", "gyro", "magnetometer", "touch_ankle_#a", "touch_ankle_#b"),
    *("jointvel_hip_#_z", "jointvel_hip_#_y", "jointvel_ankle_#", "ballangvel_rear"),
    *("jointpos_hip_#_z", "jointpos_hip_#_y", "jointpos_ankle_#", "ballquat_rear"),
    *("buttons_lidar", "goal_lidar", "circle_lidar", "hazards_lidar", "pillars_lidar"),
    *("vases_lidar", "box_lidar", "gremlins_lidar", "qpos", "qvel"),
)


def safety_gymnasium_columns(columns: Sequence[str]) -> list[str]:
    """Names of an environment's columns in the order of Safety-Gymnasium and DSRL.

    Raises:
        ValueError: If the environment observes what their tasks do not.
    """
    kinds = [sub(r"\d", "#", name.partition("[")[0]) for name in columns]
    if unknown := set(kinds) - set(_SAFETY_GYMNASIUM):
        raise ValueError(f"Safety-Gymnasium does not observe {', '.join(sorted(unknown))}.")
    order = sorted(range(len(columns)), key=lambda at: (_SAFETY_GYMNASIUM.index(kinds[at]), at))
    return [columns[at] for at in order]


def safe_episodes(steps: TensorDictBase, limits: Mapping[str, float]) -> TensorDictBase:
    """Steps [1, M] of all complete episodes within the limits, one after the other.

    Args:
        steps: Consecutive steps [N, T]. The last episode of a row counts only if it has finished;
            an episode with a step marked as ``partial`` does not count.
        limits: Cost key -> undiscounted cost allowed per episode.
    """
    ends = steps["next", "done"].squeeze(-1).long()
    episode = ends.cumsum(-1) - ends

    def sums(values: Tensor) -> Tensor:
        """Sums over each episode of every row, [N, number of episodes]."""
        zeros = torch.zeros(len(ends), int(episode.max()) + 1, dtype=torch.float64)
        return zeros.scatter_add_(1, episode, values.squeeze(-1).double())

    is_kept = sums(steps["next", "done"]) > 0
    if (partial := steps.get(PARTIAL, None)) is not None:
        is_kept &= sums(partial) == 0
    for key, limit in limits.items():
        is_kept &= sums(steps["next", key]) <= limit * (1 + _ROUNDING)
    return steps.reshape(1, -1)[:, is_kept.gather(1, episode).reshape(-1)]


def read_hdf5(path: Path | str) -> TensorDict:
    """Transitions [1, M] of an HDF5 file, one episode after the other; needs the extra `hdf5`.

    Files have the format of

    - DSRL and D4RL: flat arrays over all episodes, ``observations``, ``actions``, ``rewards``,
      ``costs``, ``terminals``, ``timeouts``, and ``next_observations``. If the last array is
      missing, a step's next observation is the observation of the step after it. At the end of an
      episode it is then the step's own observation. The same holds for an end at which the array
      has the first observation of the next episode;
    - Minari: a group ``episode_<i>`` for each episode, with ``observations`` (one more than steps),
      ``actions``, ``rewards``, ``terminations``, ``truncations``, and ``infos`` with ``cost`` and
      any ``cost_<kind>``, one per step, or one more with the reset's 0 first. An episode without
      an end in its last step counts as truncated.

    Costs may be missing: algorithms without limits do not read them.

    Raises:
        ValueError: If the file is no HDF5 file, or damaged; if an array is missing, or does not
            have one row of numbers for each action; if a flag is neither 0 nor 1.
        ModuleNotFoundError: If h5py is not installed.
    """
    with open_hdf5(path) as file:
        nodes = _nodes(path, file)
        episodes = (name for name in nodes if fullmatch(r"episode_\d{1,18}", name))
        names = sorted(episodes, key=lambda name: int(name[8:]))
        arrays = _read_episodes(path, nodes, names) if names else _read_flat(path, nodes)
    number = len(arrays["action"])
    if not number:
        raise ValueError(f"{path} holds no transitions.")
    steps = TensorDict(batch_size=[1, number])
    for key, array in arrays.items():
        native = array.astype(array.dtype.newbyteorder("="), copy=False)
        column = torch.from_numpy(native.reshape(1, number, -1))
        steps[key] = column if key in _FLAGS else column.float()
    steps["next", "done"] = steps["next", "terminated"] | steps["next", "truncated"]
    return steps


@contextmanager
def open_hdf5(path: Path | str) -> Iterator[Any]:
    """Open an HDF5 file of unknown origin; errors of reading are ValueErrors."""
    h5py = import_extra("h5py", "hdf5")
    if not (Path(path).is_file() and h5py.is_hdf5(path)):
        raise ValueError(f"{path} is neither the folder of a recording nor an HDF5 file.")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except (OSError, KeyError, RuntimeError, TypeError, MemoryError, UnicodeError) as error:
        words = printable(" ".join(str(error).split()))
        raise ValueError(f"{path} cannot be read, is it whole? {words}") from error


def _nodes(place: Path | str, group: Any) -> dict[str, Any]:
    """The arrays and groups in a group, all of which must be in the file itself."""
    for name in group:
        # opening what a link to another file names could wait, or read any file of this machine
        if not hasattr(group.get(name, getlink=True), "filename"):
            node = group[name]
            if not (getattr(node, "external", None) or getattr(node, "is_virtual", False)):
                continue
        raise ValueError(f"{place}: its {printable(name)} is in another file, which is not read.")
    return {name: group[name] for name in group}


def _values(place: Path | str, node: Any) -> np.ndarray:
    if not hasattr(node, "nbytes"):  # a group, or the name of a type
        raise ValueError(f"{place}: its {printable(node.name or 'entry')} is no array.")
    if node.nbytes > _MEMORY:
        raise ValueError(
            f"{place}: an array has the shape {node.shape}, which does not fit into the memory."
        )
    return node[:]


def _read_episodes(path: Path | str, nodes: Mapping[str, Any], names: list[str]) -> Arrays:
    episodes = [_read_episode(f"{path}, {name}", nodes[name]) for name in names]
    for name, episode in zip(names, episodes, strict=True):
        if episode.keys() != episodes[0].keys():
            raise ValueError(f"{path}: {name} has other costs than {names[0]}.")
    return {key: np.concatenate([e[key] for e in episodes]) for key in episodes[0]}


def _read_flat(path: Path | str, nodes: Mapping[str, Any]) -> Arrays:
    arrays = _check_shapes(path, _arrays(path, nodes, _FLAT))
    here = arrays["observation"]
    ends = (arrays["next", "terminated"] | arrays["next", "truncated"]).reshape(-1)
    ends[-1:] = True  # no row follows the last one
    is_given = "next_observations" in nodes
    following = _values(path, nodes["next_observations"]) if is_given else np.roll(here, -1, 0)
    arrays = _check_shapes(path, {**arrays, ("next", "observation"): following})
    if np.array_equal(following, here) and (here != here[:1]).any():
        raise ValueError(f"{path}: its next_observations are equal to its observations.")
    is_close = np.isclose(following, np.roll(here, -1, 0), 1e-4, 1e-6, equal_nan=True)
    is_next = is_close.all(tuple(range(1, here.ndim)))
    gaps = ~is_next & ~ends
    if gaps.any():
        raise ValueError(
            f"{path}: another observation follows its step {gaps.argmax()} than next_observations "
            "says, and no episode ends there. Put steps in order of time, and mark every end of an "
            "episode in terminals or timeouts."
        )
    # at an end, an array made by a shift has the next episode's first observation, from which
    # losses would take the value of what follows a truncated step
    is_of_next = (ends & is_next).reshape(-1, *[1] * (here.ndim - 1))
    return {**arrays, ("next", "observation"): np.where(is_of_next, here, following)}


def _read_episode(place: str, group: Any) -> Arrays:
    nodes = _nodes(place, group)
    arrays = _arrays(place, nodes, _OF_AN_EPISODE)
    observed, number = arrays["observation"], len(arrays["action"])
    arrays |= {"observation": observed[:number], ("next", "observation"): observed[1:]}
    infos = _nodes(place, nodes.get("infos", {}))
    for name, node in infos.items():
        if name.startswith("cost") and _is_array(node):
            cost = _values(place, node)
            if len(cost) == number + 1 and not cost[:1].any():
                cost = cost[1:]  # the first is that of the reset
            arrays["next", name] = cost
    _check_shapes(place, arrays)
    arrays["next", "truncated"][-1:] |= ~arrays["next", "terminated"][-1:]
    return arrays


def _is_array(node: Any) -> bool:
    """Whether a node of a file is an array with a row for each step, not a number or a group."""
    return bool(getattr(node, "shape", ()))


def _arrays(place: Path | str, nodes: Mapping[str, Any], names: Mapping[NestedKey, str]) -> Arrays:
    present = [name for name, node in nodes.items() if _is_array(node)]
    if missing := sorted(set(names.values()) - {"costs"} - set(present)):
        raise ValueError(
            f"{place} has no {', '.join(missing)}: transitions are read from files like those of "
            f"DSRL or Minari. What it has: {printable(_listed(present)) or 'nothing'}."
        )
    arrays = {key: _values(place, nodes[name]) for key, name in names.items() if name in present}
    for key in _FLAGS:
        if not np.isin(arrays[key], (0, 1)).all():
            raise ValueError(f"{place}: its {names[key]} must be 0 or 1.")
    return arrays | {key: arrays[key].astype(bool) for key in _FLAGS}


def _listed(names: list[str]) -> str:
    """Names for a message, the first ten only: d3rlpy's files have several arrays per episode."""
    return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")


def _check_shapes(place: Path | str, arrays: Arrays) -> Arrays:
    """Refuse arrays that are not of the same steps, or not of numbers."""
    number, observation = len(arrays["action"]), arrays["observation"]
    observed = (number, *observation.shape[1:])
    shapes: dict[NestedKey, tuple[int, ...]] = {
        "action": arrays["action"].shape, "observation": observed, ("next", "observation"): observed
    }  # fmt: skip
    for key, array in arrays.items():
        shape = shapes.get(key, (number,))
        fits = len(array) == number and array.size == np.prod(shape)
        if not fits or array.dtype.kind not in "biuf":
            name = key if isinstance(key, str) else " ".join(key)
            raise ValueError(
                f"{place}: the {name} must be numbers of shape {shape}, as there are {number} "
                f"actions, not {array.dtype} of shape {array.shape}."
            )
    return arrays
