"""The version of the code that a run uses, kept in its folder."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from safe_rl.files import read_json, replace_json


def note_code(path: Path, steps: int) -> None:
    """Add the present version of the code to the file that lists the versions of a run.

    The file is a list of JSON objects: the entries of `code_of`, and the ``steps`` that the run had
    made.
    """
    try:
        entries = [entry for entry in read_json(path) if entry["steps"] < steps]
    except (OSError, ValueError, TypeError, KeyError):
        entries = []  # there is no file yet, or it is damaged
    code = code_of()
    if not entries or any(entries[-1].get(name) != value for name, value in code.items()):
        entries.append({"steps": steps, **code})
    replace_json(path, entries)


@cache
def code_of() -> Mapping[str, Any]:
    """The code of this process: ``version``, ``commit`` and ``changed``.

    The last two are None if the package is not in a checkout, or Git is missing.

    Examples:
        >>> sorted(code_of())
        ['changed', 'commit', 'version']
    """
    module = import_module("safe_rl")
    commit, changed = commit_of(Path(str(module.__file__)))
    return {"version": module.__version__, "commit": commit, "changed": changed}


def commit_of(file: Path) -> tuple[str | None, bool | None]:
    """The commit of the checkout that a file belongs to, and whether it has been changed since.

    Both are None if Git does not track the file: an installed package may be inside the checkout of
    another project.

    Examples:
        >>> commit_of(Path("/nowhere/module.py"))
        (None, None)
    """
    known = _git(file.parent, "ls-files", "--error-unmatch", file.name)
    description = known and _git(
        file.parent, "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"
    )
    if not description:
        return None, None
    return description.removesuffix("-dirty"), description.endswith("-dirty")


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
