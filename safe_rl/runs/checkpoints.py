"""Checkpoints of a run: the last few and the best feasible one, written atomically.

A checkpoint is one archive of :class:`torchrl.checkpoint.Checkpoint`, whose tensors are loaded
weights-only: reading one runs no code of its.
"""

from __future__ import annotations

import math
import shutil
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.checkpoint import (
    Checkpoint,
    CheckpointError,
    CheckpointRotation,
    StateDictCheckpointAdapter,
)

from safe_rl.algorithms.contract import Stateful

__all__ = ["CheckpointStore"]


class CheckpointStore:
    """The checkpoints in a run's folder.

    ``last/`` keeps the newest, ``best/`` the one with the highest return among those in which
    every cost was within its limit. Names carry the number of environment steps.

    Args:
        directory: Folder of the checkpoints.
        components: Parts of the run, by name.
        keep_last: Number of newest checkpoints to keep.

    Examples:
        >>> import tempfile, torch
        >>> network = torch.nn.Linear(2, 1)
        >>> folder = tempfile.mkdtemp()
        >>> store = CheckpointStore(folder, {"network": network}, keep_last=2)
        >>> for steps in (100, 200, 300):
        ...     path = store.save(steps)
        >>> [path.name for path in store.last.checkpoints()]
        ['checkpoint-000000000200.torchrl', 'checkpoint-000000000300.torchrl']
        >>> store.save_best(300, score=1.0), store.save_best(400, score=0.5)
        (True, False)
        >>> CheckpointStore.load(store.last.latest(), {"network": torch.nn.Linear(2, 1)})
    """

    def __init__(
        self, directory: Path | str, components: Mapping[str, Stateful], *, keep_last: int
    ) -> None:
        directory = Path(directory)
        self._components = dict(components)
        self._checkpoint = _checkpoint(components)
        self.last = CheckpointRotation(directory / "last", keep_last=keep_last)
        self.best = CheckpointRotation(directory / "best", keep_last=1)

    def save(self, steps: int, metadata: Mapping[str, Any] | None = None) -> Path:
        """Write a checkpoint and drop the oldest that is too many.

        Args:
            steps: Environment steps so far.
            metadata: JSON-compatible facts, readable without loading.
        """
        return self.last.save(self._checkpoint, step=steps, metadata=metadata)

    def save_best(
        self, steps: int, score: float, metadata: Mapping[str, Any] | None = None
    ) -> bool:
        """Write a checkpoint if ``score`` is higher than that of the best one.

        Returns:
            Whether it was written.
        """
        latest = self.best.latest()
        best = -math.inf if latest is None else Checkpoint.manifest(latest)["metadata"]["score"]
        if not score > best:
            return False
        self.best.save(self._checkpoint, step=steps, metadata={**(metadata or {}), "score": score})
        return True

    def resume(self) -> Path | None:
        """Restore the newest checkpoint, or with a warning the next older one if it is damaged.

        The best one goes if it is newer than the restored: what it was the best of is forgotten.
        So do the beginnings of checkpoints during whose writing the run was killed.

        Returns:
            The checkpoint, or None if there is none.

        Raises:
            CheckpointError: If no checkpoint can be used; the message is about the newest.
        """
        failures: list[CheckpointError] = []
        restored = None
        for path in sorted(self.last.directory.glob("checkpoint-*.torchrl"), reverse=True):
            try:
                self.load(path, self._components)
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
        for best in self.best.checkpoints():
            if restored is None or best.name > restored.name:
                best.unlink()
        for rotation in (self.last, self.best):
            for begun in rotation.directory.glob(".checkpoint-*.stage-*"):
                shutil.rmtree(begun) if begun.is_dir() else begun.unlink()
        return restored

    @staticmethod
    def newest_step(directory: Path | str) -> int:
        """Environment steps of the newest checkpoint in a folder, 0 if there is none."""
        newest = CheckpointRotation(Path(directory) / "last", keep_last=1).latest()
        return 0 if newest is None else int(newest.stem.rpartition("-")[2])

    @staticmethod
    def load(path: Path, components: Mapping[str, Stateful]) -> None:
        """Restore ``components`` from a checkpoint that has them, other parts of it aside.

        Raises:
            CheckpointError: If the file is no checkpoint, or does not fit the components.
        """
        try:
            _checkpoint(components).load(path)
        except (CheckpointError, zipfile.BadZipFile, OSError) as error:
            raise CheckpointError(f"Cannot use the checkpoint {path}: {error}") from error


def _checkpoint(components: Mapping[str, Stateful]) -> Checkpoint:
    # torch's format restores in one read and refuses everything but tensors and plain containers;
    # one archive per checkpoint instead of hundreds of files
    adapter = StateDictCheckpointAdapter(payload_format="torch")
    checkpoint = Checkpoint(format="archive")
    for name, component in components.items():
        checkpoint.register(name, component, adapter=adapter)
    return checkpoint
