"""Saving and restoring the state of objects that are not torch modules.

This is directly in ``safe_rl/``, because several folders have such objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

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

    state_names: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> Mapping[str, Any]:
        """Everything that an exact continuation needs, by name."""
        return {name: _saved(getattr(self, name)) for name in self.state_names}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> Any:
        """Restore what :meth:`state_dict` has returned.

        Raises:
            ValueError: If a number was saved as a value of another type.
        """
        for name in self.state_names:
            own = getattr(self, name)
            value = _restored(own, state_dict[name])
            if value is not own:
                setattr(self, name, value)


def _saved(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value.clone()
    if isinstance(value, torch.Generator):
        return value.get_state()
    if isinstance(value, Mapping):
        return {name: _saved(part) for name, part in value.items()}
    return value.state_dict() if hasattr(value, "state_dict") else value


def _restored(own: Any, saved: Any) -> Any:
    """The new value of an attribute: the saved value, or the object after it has loaded it."""
    if isinstance(own, Tensor):
        return saved.to(own, copy=True)
    if isinstance(own, Mapping):
        return {name: _restored(part, saved[name]) for name, part in own.items()}
    if isinstance(own, torch.Generator):
        own.set_state(saved.cpu())
    elif hasattr(own, "load_state_dict"):
        own.load_state_dict(saved)
    elif isinstance(own, int | float) and type(saved) is not type(own):
        raise ValueError(f"there is {str(saved)[:40]!r} where a number has to be.")
    else:
        return saved
    return own
