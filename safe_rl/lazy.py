"""Names of a package that are imported at their first use (PEP 562).

`train.py --help` and error messages need only names of environments and tables of keys, and not
torch, TorchRL and MuJoCo, which take seconds to import.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any


def import_later(
    package: str, homes: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return a package's ``__getattr__``, which imports names, and ``__dir__``, which lists them.

    It also changes the class of the package object. Otherwise, importing a module such as
    ``safe_rl.evaluate`` would replace the package's function of the same name.

    Args:
        package: Name of the package.
        homes: Module, named from the package -> names that it defines.
    """
    modules = {name: f"{package}.{home}" for home, names in homes.items() for name in names}

    class Package(ModuleType):
        def __setattr__(self, name: str, value: Any) -> None:
            # such as the module safe_rl.evaluate
            if not (name in modules and isinstance(value, ModuleType)):
                super().__setattr__(name, value)

    sys.modules[package].__class__ = Package

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(import_module(modules[name]), name)

    def names() -> list[str]:
        own = vars(sys.modules[package])
        special = {name for name in own if name.startswith("__")}
        return sorted({*special, *own.get("__all__", ()), *modules})

    return find, names
