"""Names of a package that are imported at their first use (PEP 562).

`train.py --help` and error messages need only names of environments and tables of keys, and not
torch, TorchRL and MuJoCo, which take seconds to import.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

__all__ = ["import_later"]


def import_later(
    package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return a package's ``__getattr__``, which imports names, and ``__dir__``, which lists them.

    Args:
        package: Name of the package.
        homes: Name -> the module that defines it.

    Examples:
        >>> find, names = import_later("safe_rl.lazy", {"sqrt": "math"})
        >>> find("sqrt")(9.0)
        3.0
        >>> "sqrt" in names()
        True
        >>> find("root")
        Traceback (most recent call last):
        AttributeError: module 'safe_rl.lazy' has no attribute 'root'
    """

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(homes[name]), name)

    def names() -> list[str]:
        own = vars(sys.modules[package])
        special = {name for name in own if name.startswith("__")}
        return sorted({*special, *own.get("__all__", ()), *homes})

    return find, names
