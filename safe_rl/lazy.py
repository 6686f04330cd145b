"""Names of a package that are imported when somebody asks for them (PEP 562).

`train.py --help` and every refused command line need the names of environments and the tables of
keys; torch, TorchRL and MuJoCo take some seconds to import and are needed to build something.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

__all__ = ["import_later"]


def import_later(package: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return a package's ``__getattr__`` that imports names from where they are defined.

    Args:
        package: Name of the package.
        homes: Name -> the module that defines it.

    Examples:
        >>> find = import_later("mine", {"sqrt": "math"})
        >>> find("sqrt")(9.0)
        3.0
        >>> find("root")
        Traceback (most recent call last):
        AttributeError: module 'mine' has no attribute 'root'
    """

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(homes[name]), name)

    return find
