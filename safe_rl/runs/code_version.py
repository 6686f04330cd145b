"""The version of the code that a run uses, kept in its folder."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from safe_rl.files import read_json, replace_json
from safe_rl.trust import allowed


def note_code(path: Path, steps: int) -> None:
    """Add the present version of the code to the file that lists the versions of a run.

    The file is a list of JSON objects: the entries of `code_of`, the ``steps`` that the run had
    made, and in ``imports`` the same entries of each of the user's modules.
    """
    try:
        entries = [entry for entry in read_json(path) if entry["steps"] < steps]
    except (OSError, ValueError, TypeError, KeyError):
        entries = []  # there is no file yet, or it is damaged
    code = {**code_of(Path(__file__)), "version": import_module("safe_rl").__version__}
    files = {name: getattr(sys.modules.get(name), "__file__", None) for name in allowed()}
    if imports := {name: code_of(Path(file)) for name, file in files.items() if file}:
        code["imports"] = imports
    if not entries or any(entries[-1].get(name) != value for name, value in code.items()):
        entries.append({"steps": steps, **code})
    replace_json(path, entries)


@cache
def code_of(file: Path) -> Mapping[str, Any]:
    """``commit`` of a file's checkout, and whether that is ``changed``.

    Both are None if Git does not track the file: an installed package may be inside the checkout of
    another project.

    Examples:
        >>> code_of(Path("/nowhere/module.py"))["commit"] is None
        True
    """
    commit = _git(file.parent, "ls-files", "--error-unmatch", file.name) and _git(
        file.parent, "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"
    )
    return {
        "commit": commit.removesuffix("-dirty") or None,
        "changed": commit.endswith("-dirty") if commit else None,
    }


def _git(directory: Path, *arguments: str) -> str:
    """The output of Git without its newline; empty if the command fails."""
    # without locks, which could make the user's own Git commands fail
    command = ["git", "--no-optional-locks", *arguments]
    try:
        result = subprocess.run(
            command, cwd=directory, timeout=5.0, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return result.stdout.strip()
