"""Saving and restoring the state of objects that are not torch modules.

This is directly in ``safe_rl/``, because several folders have such objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor


class Resumable:
    """Base class of objects that checkpoints save: it saves the attributes in ``state_names``.

    Attributes:
        state_names: Names of the attributes that an exact continuation needs. Each is a tensor, a
            random number generator, a plain value, an object with a ``state_dict``, or a dictionary
            of these.

    Examples:
        >>> class Counter(Resumable):
        ...     state_names = ("sums", "steps")
        ...     def __init__(self):
        ...         self.sums, self.steps = torch.zeros(1), 0
        >>> counter = Counter()
        >>> counter.load_state_dict({"sums": torch.ones(1), "steps": 5})
        >>> counter.state_dict()
        {'sums': tensor([1.]), 'steps': 5}
    """

    state_names: tuple[str, ...] = ()

    def state_dict(self) -> Mapping[str, Any]:
        """Everything that an exact continuation needs, by name."""
        return {name: _saved(getattr(self, name)) for name in self.state_names}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Restore what `state_dict` has returned.

        Raises:
            ValueError: If a value is missing, or a tensor has another shape than the attribute.
        """
        for name in self.state_names:
            current = getattr(self, name)
            value = _restored(name, current, _entry(state_dict, name))
            if value is not current:
                setattr(self, name, value)


def _saved(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.clone()
    if isinstance(value, torch.Generator):
        return value.get_state()
    if isinstance(value, Mapping):
        return {name: _saved(part) for name, part in value.items()}
    return value.state_dict() if hasattr(value, "state_dict") else value


def _entry(saved: Any, name: str) -> Any:
    if not isinstance(saved, Mapping) or name not in saved:
        raise ValueError(f"there is no '{name}'.")
    return saved[name]


def _restored(name: str, current: Any, saved: Any) -> Any:
    """The new value of an attribute: the saved value, or the object after it has loaded it."""
    if isinstance(current, Tensor):
        _check_shape(name, current, saved)
        return saved.to(current, copy=True)
    if isinstance(current, Mapping):
        entries = ((key, part, _entry(saved, key)) for key, part in current.items())
        return {key: _restored(f"{name}.{key}", part, entry) for key, part, entry in entries}
    if isinstance(current, torch.Generator):
        current.set_state(saved.cpu())
    elif hasattr(current, "load_state_dict"):
        current.load_state_dict(saved)
    else:
        return saved
    return current


def _check_shape(name: str, current: Tensor, saved: Any) -> None:
    """Refuse what is no tensor of the shape of `current`; where it is empty, any length fits."""
    shape = tuple(saved.shape) if isinstance(saved, Tensor) else None
    lengths = zip(shape or (), current.shape, strict=False)
    if shape is None or len(shape) != current.ndim or any(n != m and m for n, m in lengths):
        kind = f"a {type(saved).__name__}" if shape is None else f"of the shape {list(shape)}"
        raise ValueError(f"'{name}' is {kind}, expected the shape {list(current.shape)}.")
