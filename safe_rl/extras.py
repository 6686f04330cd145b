"""Optional packages: installed as extras, imported on demand."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

_PLUGINS = {
    "hydra/launcher=joblib": "sweep",
    "hydra/launcher=ray": "sweep-ray",
    "hydra/launcher=submitit_local": "submitit",
    "hydra/launcher=submitit_slurm": "submitit",
    "hydra/sweeper=optuna": "sweep-optuna",
}


def require_extra(module: str, extra: str) -> None:
    """Check that a package which comes with one of the extras is there, without importing it.

    Args:
        module: Name of the module, or of one in the package.
        extra: The extra that installs it.

    Raises:
        ModuleNotFoundError: If it is not installed; the message says how to install it.
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
    """Import a module that comes with one of the extras, after :func:`require_extra`."""
    require_extra(module, extra)
    return importlib.import_module(module)


def needs_extra(module: str, extra: str) -> Callable[[T], T]:
    """Mark a class or function that needs a package of an extra; `check_settings` checks this."""

    def note(part: T) -> T:
        part.needed_extra = (module, extra)  # type: ignore[attr-defined]
        return part

    return note
