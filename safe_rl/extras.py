"""Packages that only a part of the work needs: installed as extras, imported on demand."""

from __future__ import annotations

import importlib
from typing import Any

__all__ = ["import_extra"]


def import_extra(module: str, extra: str) -> Any:
    """Import a module that comes with one of the package's extras.

    Args:
        module: Name of the module.
        extra: The extra that installs it.

    Raises:
        ModuleNotFoundError: If it is not installed; the message says how to install it.

    Examples:
        >>> import_extra("json", extra="report").dumps([1])
        '[1]'
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if error.name is None or error.name.partition(".")[0] != package:
            raise
        raise ModuleNotFoundError(
            f"This needs the package '{package}', which comes with the extra '{extra}': "
            f"pip install 'safe-rl[{extra}]'",
            name=error.name,
        ) from error
