"""Where the package is: in this Python, in another one, or nowhere."""

from __future__ import annotations

import os

from safe_rl.envs.errors import ConfigError

PYTHON = "SAFETY_GYMNASIUM_PYTHON"
"""What names another Python with the package: the environment, as no configuration may name a
program."""
_MISSING = (
    "Safety-Gymnasium cannot be imported in this Python ({reason}). Its release 1.0 wants an older "
    "Gymnasium and MuJoCo than safe_rl, so give it a Python of its own, 3.8 to 3.10: "
    "'python3.10 -m venv sg && sg/bin/pip install safety-gymnasium', then "
    f"'export {PYTHON}=$PWD/sg/bin/python'."
)


def other_python() -> str | None:
    """Return the Python that has the package, if one is named.

    Raises:
        ConfigError: if there is none of that name.
    """
    path = os.environ.get(PYTHON)
    if path and not os.access(path, os.X_OK):
        raise ConfigError(f"{PYTHON}={path}: there is no such program.")
    return path or None


def missing(reason: object) -> ConfigError:
    """Return the error that says what to do where the package cannot be imported."""
    return ConfigError(_MISSING.format(reason=reason))
