"""Imports on demand: of optional packages, and of a package's own names at their first use."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_PLUGINS = {
    "hydra/launcher=joblib": "sweep",
    "hydra/launcher=ray": "sweep-ray",
    "hydra/launcher=submitit_local": "submitit",
    "hydra/launcher=submitit_slurm": "submitit",
    "hydra/sweeper=optuna": "sweep-optuna",
}


def require_extra(module: str, extra: str) -> None:
    """Check that the package of a module is there, without importing it.

    Raises:
        ModuleNotFoundError: If it is not; the message says how to install it by the `extra`.
    """
    package = module.partition(".")[0]
    if find_spec(package) is None:
        raise ModuleNotFoundError(
            f"This needs the package '{package}', which comes with the extra '{extra}': "
            f"{installing(extra)}",
            name=package,
        )


def installing(extra: str) -> str:
    """The command that installs an extra, for a checkout or for the installed package."""
    checkout = Path(__file__).parents[1]
    if (checkout / "pyproject.toml").is_file():
        return f"in {checkout}, pip install -e '.[{extra}]'"
    return f"pip install 'safe-rl-torch[{extra}]'"


def hint_of_plugin(choice: str) -> str:
    """A sentence, after a space, about the extra that installs a plugin of Hydra, or "".

    Examples:
        >>> hint_of_plugin("hydra/launcher=basic")
        ''
    """
    extra = _PLUGINS.get(choice)
    return f" It comes with the extra '{extra}': {installing(extra)}" if extra else ""


def import_extra(module: str, extra: str) -> Any:
    """Import a module that comes with one of the extras, after `require_extra`."""
    require_extra(module, extra)
    return import_module(module)


def import_later(
    package: str, homes: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return a package's ``__getattr__`` (PEP 562) and ``__dir__``: names that are imported late.

    Help and error messages need names of environments and keys, but not torch, TorchRL and MuJoCo,
    which take seconds to import. `homes` maps modules, named from the package, to their names.
    """
    modules = {name: f"{package}.{home}" for home, names in homes.items() for name in names}

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        try:
            module = import_module(modules[name])
        except AttributeError as error:  # Python would say that the name does not exist
            raise ImportError(f"{modules[name]} cannot be imported: {error!r}") from error
        return getattr(module, name)

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *modules})

    return find, names
