"""Reading a batch by key, with errors that name what is missing and what is there."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor

from safe_rl.naming import key_name, nearest


def require(tensordict: TensorDictBase, key: NestedKey, hint: str = "") -> Tensor:
    """Get an entry, or raise an error that names the nearest key present.

    Args:
        tensordict: the batch to read.
        key: entry to get.
        hint: what writes this entry, for the error message.

    Raises:
        KeyError: if there is no such entry.
    """
    value = tensordict.get(key, None)
    if value is not None:
        return value
    present = {key_name(found): found for found in tensordict.keys(True, True)}
    near = nearest(key_name(unravel_key(key)), present)
    meant = "" if near is None else f" Did you mean {present[near]!r}?"
    raise KeyError(f"No entry {key!r} in the batch.{meant} Keys: {sorted(present)}. {hint}".strip())
