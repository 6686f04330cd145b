"""Checkpoints of a run: the last few and the best feasible ones, written atomically.

A file holds facts, and for every part of a run tensors, numbers and plain containers. Reading a
file of another person runs no code in it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path, PosixPath
from typing import Any

import torch
from torch import Tensor
from torchrl.checkpoint import CheckpointError

from safe_rl.algorithms.algorithm_contract import Stateful, states_of
from safe_rl.collectors import match_columns
from safe_rl.files import all_printable, load_tensors, printable, save_tensors
from safe_rl.runs.folder import checkpoint_name, checkpoint_steps, checkpoints_in
from safe_rl.runs.identity import flatten


def read_facts(path: Path) -> dict[str, Any]:
    """The facts that a checkpoint was written with, without reading its tensors."""
    return _read(path, lazy=True)["facts"]


def read_states(path: Path, names: Collection[str] | None = None) -> dict[str, Any]:
    """States of parts by name, all or those of `names`: tensors, numbers and plain containers.

    Raises:
        CheckpointError: If the file is no checkpoint, is damaged, or lacks a part.
    """
    parts = _read(path)["parts"]
    if missing := sorted(set(names or ()) - set(parts)):
        raise CheckpointError(f"The checkpoint {path} has no {' and no '.join(missing)}.")
    return {name: parts[name] for name in (parts if names is None else names)}


def policy_hash(path: Path) -> str:
    """SHA-256 of the trained actor in a checkpoint; of a policy without one, of all its parts.

    An exported policy has the same hash as the checkpoint from which it comes.
    """
    parts = _read(path, lazy=True)["parts"]
    flat = flatten(parts.get("actor", parts))
    tensors = {name: value for name, value in flat.items() if isinstance(value, Tensor)}
    digest = sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        digest.update(
            tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
        )
    return digest.hexdigest()


class HeldCheckpoint(PosixPath):
    """The path of a checkpoint that can be read after a run that trains has removed the file."""

    content: dict[str, dict[str, Any]]


def hold(path: Path) -> HeldCheckpoint:
    """Open a checkpoint for all later reading, after a check that it is not damaged."""
    _read(path)
    held = HeldCheckpoint(path)
    held.content = _read(path, lazy=True)
    return held


def _read(path: Path, *, lazy: bool = False) -> dict[str, dict[str, Any]]:
    """The content of a checkpoint; a CheckpointError says what is wrong with the file."""
    if isinstance(path, HeldCheckpoint):
        return path.content
    try:
        content = load_tensors(path, lazy=lazy)
        known = content if isinstance(content, dict) else {}
        if not all(isinstance(known.get(name), dict) for name in ("facts", "parts")):
            raise ValueError("no run of safe_rl wrote it")
        content["facts"] = all_printable(content["facts"])
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(f"Cannot use the checkpoint {path}: {error}.") from error
    return content


def check_interface(path: Path, interface: Mapping[str, Any]) -> None:
    """Refuse a checkpoint whose policy was trained on other observations of the same size.

    If it says nothing of them, it is not checked. The `interface` is that of the environment in
    which the policy is to act. A CheckpointError says which columns or sensors differ.
    """
    known = read_facts(path).get("interface")
    if not isinstance(known, dict):
        return
    columns, sensors = interface["columns"], interface["sensors"]
    try:
        if match_columns(known.get("columns"), columns, known.get("sensors"), sensors) != [
            *range(len(columns))
        ]:
            raise ValueError("their order is another one")
    except ValueError as error:
        raise CheckpointError(
            f"The policy in {path} was trained on other observations than this environment's: "
            f"{error}. Undo the env.… override that changes them."
        ) from error


def best_checkpoint(directory: Path) -> Path | None:
    """The checkpoint with the highest score in a folder, the newest among equal ones.

    One that cannot be read counts as the best, so that no other one silently takes its place.
    """
    ranked = sorted(checkpoints_in(directory), key=lambda p: (_score(p, math.inf), p.name))
    return ranked[-1] if ranked else None


def _score(path: Path, otherwise: float = -math.inf) -> float:
    """The score of a best checkpoint; `otherwise` if it cannot be read."""
    try:
        return float(read_facts(path)["score"])
    except (CheckpointError, KeyError, TypeError, ValueError):
        return otherwise


class CheckpointStore:
    """The checkpoints in a run's folder.

    ``last/`` keeps the newest checkpoints, ``best/`` those with the highest scores.

    Args:
        directory: Folder of the checkpoints.
        components: Parts of the run, by name.
        keep_last: Number of newest checkpoints to keep.
        keep_best: Number of best checkpoints to keep.
        run: JSON-compatible facts of the run. A checkpoint with other ones is not resumed.
        interface: Returns the ``interface`` of the environment.
    """

    def __init__(
        self,
        directory: Path | str,
        components: Mapping[str, Stateful],
        *,
        keep_last: int,
        keep_best: int = 1,
        run: Mapping[str, Any] | None = None,
        interface: Callable[[], Mapping[str, Any]] = dict,
    ) -> None:
        self.last = Path(directory) / "last"
        self.best = Path(directory) / "best"
        self._components = dict(components)
        # exists until the first checkpoint is written: if both are missing, checkpoints are lost
        self._none_yet = self.last / "none-yet"
        self._keep_last, self._keep_best = keep_last, keep_best
        self._run, self._interface = dict(run or {}), interface

    def begin(self) -> None:
        """Note that a run begins and has no checkpoint yet."""
        self.last.mkdir(parents=True, exist_ok=True)
        self._none_yet.touch()

    def save(self, steps: int) -> Path:
        """Write a checkpoint; remove the oldest beyond ``keep_last``."""
        path = self._write(self.last, steps, states_of(self._components))
        others = [other for other in checkpoints_in(self.last) if other != path]
        for old in others[: max(0, len(others) + 1 - self._keep_last)]:
            old.unlink()
        self._none_yet.unlink(missing_ok=True)
        self._remove_worse()
        return path

    def save_best(
        self, steps: int, score: float, *, states: Mapping[str, Any] | None = None
    ) -> bool:
        """Write a checkpoint if fewer than ``keep_best`` exist or ``score`` is above a kept one's.

        A replaced checkpoint stays until the next `save`: until then, the run would be resumed from
        a time before the new one. `states` are those of parts by name; None: the present ones.
        """
        scores = sorted(filter(math.isfinite, map(_score, checkpoints_in(self.best))))
        if len(scores) >= self._keep_best and not score > scores[-self._keep_best]:
            return False
        states = states_of(self._components) if states is None else states
        self._write(self.best, steps, states, score=score)
        last = checkpoints_in(self.last)
        self._remove_worse(after=last[-1].name if last else "")
        return True

    def _remove_worse(self, after: str = "") -> None:
        """Remove the best checkpoints beyond ``keep_best`` that are newer than a named one.

        One that cannot be read may be the best, so it stays for the user to look at.
        """
        scores = {path: _score(path) for path in checkpoints_in(self.best)}
        readable = [path for path, score in scores.items() if score > -math.inf]
        for worse in sorted(readable, key=scores.__getitem__, reverse=True)[self._keep_best :]:
            if worse.name > after:
                worse.unlink()

    def forget_best(self, steps: Iterable[int]) -> None:
        """Remove the best checkpoints, if any, with these numbers of environment steps."""
        for number in steps:
            (self.best / checkpoint_name(number)).unlink(missing_ok=True)

    def _write(
        self, directory: Path, steps: int, states: Mapping[str, Any], **facts: float
    ) -> Path:
        directory.mkdir(parents=True, exist_ok=True)
        path = directory / checkpoint_name(steps)
        held = {"run": self._run, "interface": self._interface()}
        known = facts | {name: value for name, value in held.items() if value}
        save_tensors(path, {"facts": known, "parts": dict(states)})
        return path

    def resume(self, epochs: int = 0) -> Path | None:
        """Restore the newest checkpoint; if it is damaged, an older one with a warning.

        Best checkpoints newer than the restored one are removed. None is returned if the run was
        stopped before it had written one.

        Raises:
            CheckpointError: If no checkpoint can be used (the message is about the newest), or if
                the run has finished epochs, rows of its table, and its checkpoints are missing.
        """
        failures: list[CheckpointError] = []
        restored = None
        for path in reversed(checkpoints_in(self.last)):
            try:
                self.load(path, self._components, self._run)
                restored = path
                break
            except CheckpointError as error:
                failures.append(error)
        if restored is None and failures:
            raise failures[0]
        if restored is None and epochs and not self._none_yet.exists():
            raise CheckpointError(
                f"The checkpoints of {self.last} are gone, and the run has finished {epochs} "
                "epochs, which starting over would delete. Put the checkpoints back to continue, "
                "or move the run's folder away to start over."
            )
        if restored is not None and failures:
            warnings.warn(
                f"{failures[0]} Continuing from the older {restored.name} instead.", stacklevel=2
            )
        for best in checkpoints_in(self.best):
            if restored is None or best.name > restored.name:
                best.unlink()
        return restored

    @staticmethod
    def load(
        path: Path, components: Mapping[str, Stateful], run: Mapping[str, Any] | None = None
    ) -> None:
        """Restore ``components`` from a checkpoint, which may have further parts.

        All are read before the first is changed. Facts of the ``run`` must be equal to those in the
        checkpoint, if it has them.

        Raises:
            CheckpointError: If the file is no checkpoint, does not fit the components, or is
                another run's.
        """
        known = read_facts(path).get("run")
        for key, expected in (run or {}).items():
            if isinstance(known, dict) and known.get(key, expected) != expected:
                raise CheckpointError(
                    f"The checkpoint {path} is another run's: its {key} is {known[key]}, this "
                    f"run's is {expected}. For a new run from its networks use init_from=."
                )
        states = read_states(path, components)
        for name in sorted(states):
            try:
                components[name].load_state_dict(states[name])
            except Exception as error:  # a part of unknown origin can be wrong in any way
                words = printable(" ".join(str(error).split()))
                raise CheckpointError(
                    f"Cannot use the checkpoint {path}: its {name!r} does not fit: {words}"
                ) from error


def is_finished(checkpoints: Sequence[Path], frames: int) -> bool:
    """Whether the newest readable one of a run's checkpoints was written after ``frames`` steps."""
    for path in reversed(checkpoints):
        with suppress(CheckpointError):
            read_facts(path)
            return (checkpoint_steps(path) or 0) >= frames
    return False
