"""Transitions of a run on disk: written batch by batch, and read back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from safe_rl.files import load_tensors, printable, read_json, replace_json, save_tensors

INTERFACE = "recording.json"
"""File of a recording with the ``interface`` of its environment: columns, units of actions.

``evaluating`` is true in it if an evaluation was recorded, and not a training."""
PARTIAL = "partial"
"""Entry [N, T, 1] bool, true in at least one step of an episode that is not recorded completely."""

# other entries, such as those that a policy writes, are not recorded
_FLAGS = ("done", "terminated", "truncated")


def read_interface(folder: Path | str) -> dict[str, Any]:
    """The ``interface`` of the environment that was recorded; empty if the folder has none.

    Raises:
        ValueError: If the file cannot be read.
    """
    path = Path(folder) / INTERFACE
    interface = read_json(path) if path.exists() else {}
    if not isinstance(interface, dict):
        raise ValueError(f"{path} does not describe a recording.")
    return interface


def match_columns(
    columns: Any, wanted: Sequence[str], sensors: Any = None, of_env: Mapping[str, Any] = {}
) -> list[int]:
    """Where in other columns the columns of an environment are, by their names.

    `columns` are the other names, of unknown origin, and `wanted` the environment's
    ``column_names``; `sensors` and `of_env` are the ``sensor_keys`` of both, None if unknown.

    Raises:
        ValueError: If names or keys differ; the message says which.
    """
    if not isinstance(columns, list) or not all(isinstance(name, str) for name in columns):
        raise ValueError("their columns are not a list of names")
    if sorted(columns) != sorted(wanted):
        both = (set(columns) - set(wanted), set(wanted) - set(columns))
        kinds = ({name.partition("[")[0] for name in names} for names in both)
        others, missing = (", ".join(sorted(names)) or "nothing" for names in kinds)
        raise ValueError(printable(f"they have {others}, where this environment has {missing}"))
    for key, value in of_env.items():
        if isinstance(sensors, dict) and sensors.get(key, value) != value:
            raise ValueError(
                printable(f"their {key} is {sensors[key]}, and that of this environment {value}")
            )
    return [columns.index(name) for name in wanted]


class Recording:
    """A folder with the transitions of a run, one file of `torch.save` per batch [N, T].

    Args:
        folder: Path of the folder, which is made if it does not exist.
        cost_keys: Costs below ``next`` that are recorded.
        interface: Columns and units, ``interface`` of the environment. None: they are those of the
            environment in which the recording is used.
        is_privileged: Whether the entry ``privileged`` is recorded, which critics may read.

    Raises:
        KeyError: When a batch is written that lacks one of the entries.

    Examples:
        >>> folder, seen = getfixture("tmp_path"), torch.ones(1, 3, 1)
        >>> following = {"observation": seen, "reward": seen, "cost": seen}
        >>> following |= dict.fromkeys(["done", "terminated", "truncated"], seen < 0)
        >>> batch = TensorDict(observation=seen, action=seen, next=following, batch_size=[1, 3])
        >>> recording = Recording(folder, ["cost"])
        >>> recording.write(0, batch)
        >>> recording.write(1, batch)
        >>> read_recording(folder).shape
        torch.Size([1, 6])
    """

    def __init__(
        self,
        folder: Path | str,
        cost_keys: Sequence[str],
        interface: Mapping[str, Any] | None = None,
        *,
        is_privileged: bool = False,
    ) -> None:
        self.folder, self._interface = Path(folder), interface
        read = ("observation", "privileged") if is_privileged else ("observation",)
        following = (*read, "reward", *cost_keys, *_FLAGS)
        self._keys = [*read, "action", *(("next", key) for key in following)]
        self._cut: int | None = None  # number of the last batch after which new episodes begin

    def begin(self, number: int = 0) -> None:
        """Remove the batches of an earlier recording with this number and higher ones.

        That of a run lies in its folder, which `lock_folder` refuses if it holds links.
        """
        unfinished = self.folder.glob(".*.pt")  # of a run that was killed
        for path in [*unfinished, *(p for p in _pieces(self.folder) if int(p.stem) >= number)]:
            path.unlink()
        if not number:
            (self.folder / INTERFACE).unlink(missing_ok=True)

    def write(self, number: int, batch: TensorDictBase, *, begun: Tensor | None = None) -> None:
        """Write a batch [N, T]; an earlier file with the same number is replaced.

        If batch ``number - 1`` is missing, the unfinished episodes at the end of the last recorded
        batch are truncated there and marked as partial.

        Args:
            number: Number of the batch in order of time.
            batch: Consecutive steps.
            begun: Rows [N] that start within an episode, bool. If the batch before is missing or
                was cut off, these episodes are marked as partial.
        """
        steps = batch.select(*self._keys).cpu()
        steps[PARTIAL] = torch.zeros_like(steps["next", "done"])
        if not self._place(number - 1).exists():
            before = [n for path in _pieces(self.folder) if (n := int(path.stem)) < number]
            self.cut_after(max(before, default=-1))
            self._cut = number - 1
        if begun is not None and self._cut == number - 1:
            steps[PARTIAL][:, 0] |= begun.cpu().unsqueeze(-1)
        self._store(number, steps)

    def cut_after(self, number: int) -> None:
        """Truncate a batch's unfinished episodes, mark them as partial; new episodes follow."""
        self._cut = number
        if not self._place(number).exists():
            return
        steps = _read(self._place(number))
        is_open = ~steps["next", "done"][:, -1]
        for key in (PARTIAL, ("next", "done"), ("next", "truncated")):
            steps[key][:, -1] |= is_open
        self._store(number, steps)

    def _place(self, number: int) -> Path:
        return self.folder / f"{number:08d}.pt"

    def _store(self, number: int, steps: TensorDictBase) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        if self._interface is not None and not (self.folder / INTERFACE).exists():
            replace_json(self.folder / INTERFACE, self._interface)
        # of a view, torch would save the whole underlying storage
        save_tensors(self._place(number), steps.clone().to_dict())


class StepRecorder:
    """Collects single steps [N] and writes many at a time to a recording.

    Args:
        recording: Recording that gets batches 0, 1, 2, …; those that it has already are removed.
        steps: Number of steps per batch.

    Examples:
        >>> recorder = StepRecorder(Recording(getfixture("tmp_path"), ["cost"]), steps=2)
        >>> recorder.flush()  # after a call with each step
    """

    def __init__(self, recording: Recording, steps: int = 500) -> None:
        recording.begin()
        self._recording, self._number = recording, steps
        self._steps: list[TensorDictBase] = []
        self._written = 0

    def __call__(self, step: TensorDictBase) -> None:
        """Add the next step [N]."""
        self._steps.append(step.clone())
        if len(self._steps) == self._number:
            self.flush()

    def flush(self) -> None:
        """Write what has not been written yet."""
        if self._steps:
            self._recording.write(self._written, torch.stack(self._steps, -1))
            self._steps, self._written = [], self._written + 1


def read_recording(folder: Path | str) -> TensorDict:
    """Transitions [N, T] of a folder in order of time, in main memory.

    ``partial`` is true in at least one step of an incomplete episode. Episodes are incomplete if
    rows began within an episode (``staggered_starts``). They are incomplete, and truncated, if the
    run was resumed without the state of its environments, or went on without recording.

    Raises:
        FileNotFoundError: If the folder has no transitions.
        ValueError: If a batch is missing, cannot be read, or holds more than tensors.
    """
    pieces = _pieces(Path(folder))
    if not pieces:
        below = sorted(path for path in Path(folder).glob("*transitions*") if _pieces(path))
        places = " or ".join(map(str, below))
        hint = f"give {places}." if below else "is it the folder of a recording?"
        raise FileNotFoundError(f"{folder} holds no transitions: {hint}")
    batches = [_read(path) for path in pieces]
    for before, after, batch in zip(pieces, pieces[1:], batches, strict=False):
        # a run that was not recorded for a while has ended the episodes there
        if int(after.stem) != int(before.stem) + 1 and not batch["next", "done"][:, -1].all():
            raise ValueError(
                f"{folder}: batches between {before.name} and {after.name} are missing."
            )
    return torch.cat(batches, -1)


def _read(path: Path) -> TensorDict:
    try:
        entries = load_tensors(path)
        return TensorDict(entries, batch_size=entries["action"].shape[:2])
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} cannot be read as steps of a run: {error}") from error


def _pieces(folder: Path) -> list[Path]:
    """Files of the batches, in order of their numbers."""
    return sorted(folder.glob("[0-9]*.pt"))
