"""One checkpoint file: its content, and reading one that another person made.

A file is an archive of :class:`torchrl.checkpoint.Checkpoint` that holds, for every part of a run,
tensors, numbers and plain containers. Reading a file runs no code in it: TorchRL also reads other
payloads, some of them by unpickling, and all of those are refused.
"""

from __future__ import annotations

import stat
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from zipfile import ZIP_STORED, BadZipFile, ZipFile

import torch
from torch import Tensor, nn
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

from safe_rl.algorithms.algorithm_contract import Stateful

__all__ = ["as_parts", "part_names", "read_facts", "read_states", "restore", "writer"]


class _WeightsOnly(StateDictCheckpointAdapter):
    """A part's payload: exactly one file, written by `torch.save` and read weights-only."""

    def __init__(self) -> None:
        # restores in one read; one archive per checkpoint instead of hundreds of files
        super().__init__(payload_format="torch")

    def load(self, component: Any, path: Path, **options: Any) -> Any:
        # where its own file is missing, the adapter falls back to formats that unpickle
        found = sorted(path.iterdir())
        if [file.name for file in found] != [self.state_torch]:
            raise CheckpointError(
                f"it holds {[file.name for file in found]}, where only {self.state_torch} may be: "
                "this package has not written it, and it is not read."
            )
        if not stat.S_ISREG(found[0].lstat().st_mode):
            raise CheckpointError(f"its {self.state_torch} is no file.")
        options["tensor_load_kwargs"] = {"weights_only": True}
        return super().load(component, path, **options)


class _State:
    """The state of a part, to be written or just read."""

    def __init__(self, state: Any = None) -> None:
        self.state = state

    def state_dict(self) -> Mapping[str, Any]:
        return {} if self.state is None else self.state

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        self.state = state_dict


def writer(components: Mapping[str, Stateful]) -> Checkpoint:
    """The checkpoint of TorchRL's that writes the present states of parts, by name, into a file."""
    checkpoint = Checkpoint(format="archive")
    adapter = _WeightsOnly()
    for name, component in components.items():
        checkpoint.register(name, component, adapter=adapter)
    return checkpoint


def as_parts(states: Mapping[str, Any]) -> dict[str, Stateful]:
    """States by name as parts that have them, for :func:`writer`."""
    return {name: _State(state) for name, state in states.items()}


def read_facts(path: Path) -> dict[str, Any]:
    """The facts that a checkpoint was written with, without reading its tensors.

    Raises:
        CheckpointError: If the file is no checkpoint.
    """
    try:
        _check_kind(path)
        facts = Checkpoint.manifest(path)["metadata"]
        if not isinstance(facts, dict):
            raise CheckpointError("its facts are no mapping.")
        return facts
    except Exception as error:  # a file of unknown origin can be wrong in any way
        raise _cannot_use(path, error) from error


def read_states(path: Path, names: Collection[str]) -> dict[str, Any]:
    """States of some parts by name: tensors, numbers and plain containers.

    Raises:
        CheckpointError: If the file is no checkpoint, is damaged, or lacks a part.
    """
    received = {name: _State() for name in names}
    # without a GPU, tensors of one are read into main memory
    device = None if torch.cuda.is_available() else "cpu"
    try:
        _check_kind(path)
        writer(received).load(path, map_location=device)
    except Exception as error:
        raise _cannot_use(path, error) from error
    return {name: part.state for name, part in received.items()}


def restore(path: Path, components: Mapping[str, Stateful]) -> None:
    """Give parts the states of a checkpoint, all of which are read before the first is changed.

    Raises:
        CheckpointError: If the file is no checkpoint, or does not fit the parts.
    """
    states = read_states(path, components.keys())
    for name in sorted(states):
        try:
            _check_types(components[name], states[name])
            components[name].load_state_dict(states[name])
        except Exception as error:
            raise _cannot_use(path, error, f"its {name!r} does not fit: ") from error


def _check_types(component: Stateful, state: Mapping[str, Any]) -> None:
    """Refuse weights of another dtype than the network's, which would be converted silently."""
    if not isinstance(component, nn.Module):
        return
    for name, tensor in component.state_dict().items():
        given = state.get(name) if isinstance(tensor, Tensor) else None
        if isinstance(given, Tensor) and given.dtype != tensor.dtype:
            raise ValueError(f"'{name}' is {given.dtype}, where the network has {tensor.dtype}.")


def part_names(path: Path) -> set[str]:
    """Names of the parts in a file; empty if it cannot be read."""
    try:
        _check_kind(path)
        return set(Checkpoint.manifest(path)["components"])
    except Exception:  # reading the states raises the error
        return set()


def _check_kind(path: Path) -> None:
    """Refuse a folder, and compressed parts, which could fill the main memory."""
    if path.is_dir():
        raise CheckpointError("it is a folder, and a checkpoint is one file.")
    with ZipFile(path) as archive:
        infos = archive.infolist()
        for info in infos:
            if info.filename.endswith(".pt") and info.compress_type == ZIP_STORED:
                with archive.open(info) as part, suppress(BadZipFile), ZipFile(part) as inner:
                    infos = [*infos, *inner.infolist()]
    if any(info.compress_type or info.file_size > info.compress_size for info in infos):
        raise CheckpointError("it has compressed parts, and no run writes such.")


def _cannot_use(path: Path, error: Exception, part: str = "") -> CheckpointError:
    has_words = isinstance(error, OSError | RuntimeError | ValueError)
    words = " ".join(str(error).split()) if has_words else f"{type(error).__name__}: {error}"
    if "weights_only" in words:  # torch's own message advises to turn this off
        words = "it holds more than tensors, numbers and plain containers, and is not read."
    return CheckpointError(f"Cannot use the checkpoint {path}: {part}{words}")
