"""Checkpoints of a run: the last few and the best feasible one, written atomically."""

from __future__ import annotations

import math
import re
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.checkpoint import CheckpointError

from safe_rl.algorithms.contract import Stateful
from safe_rl.runs.archive import read_facts, restore, writer

__all__ = ["CheckpointStore", "checkpoint_steps", "checkpoints_in"]

_NAME = re.compile(r"checkpoint-(\d+)\.torchrl")


def checkpoint_steps(path: Path) -> int | None:
    """Environment steps that a checkpoint's name carries, if it is one's name.

    Examples:
        >>> checkpoint_steps(Path("last/checkpoint-000000000300.torchrl"))
        300
    """
    match = _NAME.fullmatch(path.name)
    return None if match is None else int(match.group(1))


def checkpoints_in(directory: Path) -> list[Path]:
    """Checkpoints in a folder by ascending steps, readable or not; none if there is no folder."""
    found = directory.iterdir() if directory.is_dir() else ()
    steps = {path: checkpoint_steps(path) for path in found}
    return sorted((path for path in steps if steps[path] is not None), key=lambda p: steps[p] or 0)


class CheckpointStore:
    """The checkpoints in a run's folder.

    ``last/`` keeps the newest, ``best/`` the one with the highest return among those in which
    every cost was within its limit. Names carry the number of environment steps.

    Args:
        directory: Folder of the checkpoints.
        components: Parts of the run, by name.
        keep_last: Number of newest checkpoints to keep.
        run: JSON-compatible facts of the run that every checkpoint holds: one with others is not
            resumed from.

    Examples:
        >>> import tempfile, torch
        >>> network = torch.nn.Linear(2, 1)
        >>> folder = tempfile.mkdtemp()
        >>> store = CheckpointStore(folder, {"network": network}, keep_last=2)
        >>> for steps in (100, 200, 300):
        ...     path = store.save(steps)
        >>> [path.name for path in checkpoints_in(store.last)]
        ['checkpoint-000000000200.torchrl', 'checkpoint-000000000300.torchrl']
        >>> store.save_best(300, score=1.0), store.save_best(400, score=0.5)
        (True, False)
        >>> CheckpointStore.load(path, {"network": torch.nn.Linear(2, 1)})
    """

    def __init__(
        self,
        directory: Path | str,
        components: Mapping[str, Stateful],
        *,
        keep_last: int,
        run: Mapping[str, Any] | None = None,
    ) -> None:
        self.last = Path(directory) / "last"
        self.best = Path(directory) / "best"
        self._components = dict(components)
        self._writer = writer(components)
        self._keep_last = keep_last
        self._run = dict(run or {})

    def save(self, steps: int, facts: Mapping[str, Any] | None = None) -> Path:
        """Write a checkpoint and drop the oldest that is too many.

        Args:
            steps: Environment steps so far.
            facts: JSON-compatible facts, readable without loading.
        """
        return self._save(self.last, steps, facts, self._keep_last)

    def save_best(self, steps: int, score: float, facts: Mapping[str, Any] | None = None) -> bool:
        """Write a checkpoint if ``score`` is higher than that of the best one.

        Returns:
            Whether it was written.
        """
        if not score > self._best_score():
            return False
        self._save(self.best, steps, {**(facts or {}), "score": score}, keep=1)
        return True

    def _best_score(self) -> float:
        for path in reversed(checkpoints_in(self.best)):
            try:
                return float(read_facts(path)["score"])
            except (CheckpointError, KeyError, TypeError, ValueError):
                continue
        return -math.inf

    def _save(
        self, directory: Path, steps: int, facts: Mapping[str, Any] | None, keep: int
    ) -> Path:
        path = directory / f"checkpoint-{steps:012d}.torchrl"
        facts = {**(facts or {}), **({"run": self._run} if self._run else {})}
        self._writer.save(path, metadata=facts)
        others = [other for other in checkpoints_in(directory) if other != path]
        for old in others[: max(0, len(others) + 1 - keep)]:
            old.unlink()
        return path

    def resume(self) -> Path | None:
        """Restore the newest checkpoint, or with a warning the next older one if it is damaged.

        The best one goes if it is newer than the restored: what it was the best of is forgotten.
        So do the beginnings of checkpoints during whose writing the run was killed.

        Returns:
            The checkpoint, or None if there is none.

        Raises:
            CheckpointError: If no checkpoint can be used; the message is about the newest.
        """
        _clear_beginnings(self.last)
        failures: list[CheckpointError] = []
        restored = None
        for path in reversed(checkpoints_in(self.last)):
            try:
                self.load(path, self._components, self._run)
            except CheckpointError as error:
                failures.append(error)
                continue
            restored = path
            break
        if restored is None and failures:
            raise failures[0]
        if restored is not None and failures:
            warnings.warn(
                f"{failures[0]} Going on from the older {restored.name} instead.", stacklevel=2
            )
        _clear_beginnings(self.best)
        for best in checkpoints_in(self.best):
            if restored is None or best.name > restored.name:
                best.unlink()
        return restored

    @staticmethod
    def newest_step(directory: Path | str) -> int:
        """Environment steps of the newest whole checkpoint in a folder, 0 if there is none."""
        for path in reversed(checkpoints_in(Path(directory) / "last")):
            try:
                read_facts(path)
            except CheckpointError:
                continue
            return checkpoint_steps(path) or 0
        return 0

    @staticmethod
    def load(
        path: Path, components: Mapping[str, Stateful], run: Mapping[str, Any] | None = None
    ) -> None:
        """Restore ``components`` from a checkpoint that has them, other parts of it aside.

        Args:
            path: The file.
            components: Parts by name; all are read before the first is changed.
            run: Facts that the run must have had, where its checkpoint names them.

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
        restore(path, components)


def _clear_beginnings(directory: Path) -> None:
    """Remove what a run that was killed while it saved has left, but for a file put aside."""
    for remains in directory.glob(".checkpoint-*"):
        name, _, kind = remains.name[1:].rpartition(".")
        if kind.startswith("backup-") and not (directory / name).exists():
            remains.rename(directory / name)
        elif remains.is_dir() and not remains.is_symlink():
            shutil.rmtree(remains)
        else:
            remains.unlink()
