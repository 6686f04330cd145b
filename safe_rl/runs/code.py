"""Which code a run is carried out by: the package's version and, in a checkout, Git's commit."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from safe_rl.runs.files import replace_text

__all__ = ["code_of", "commit_of", "note_code"]

# not to be taken for another checkout's by what a hook has set, nor to write into anybody's index
_CLEARED = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")
_PATIENCE = 5.0  # seconds


def note_code(path: Path, steps: int) -> None:
    """Add the code that carries a run on from here to the file that lists them.

    Args:
        path: The file, a list of JSON objects with ``steps``, ``version``, ``commit`` and
            ``changed``; see :func:`code_of`.
        steps: Environment steps that the run has behind it.
    """
    entries = [entry for entry in _read(path) if entry["steps"] < steps]
    code = code_of()
    if not entries or any(entries[-1].get(name) != value for name, value in code.items()):
        entries.append({"steps": steps, **code})
    replace_text(path, json.dumps(entries, indent=2) + "\n")


@cache
def code_of() -> Mapping[str, Any]:
    """What this process has imported: ``version``, ``commit`` and ``changed``.

    The last two are None if the package stands in no checkout, or Git is missing.

    Examples:
        >>> sorted(code_of())
        ['changed', 'commit', 'version']
    """
    module = import_module("safe_rl")
    commit, changed = commit_of(Path(str(module.__file__)))
    return {"version": module.__version__, "commit": commit, "changed": changed}


def commit_of(file: Path) -> tuple[str | None, bool | None]:
    """The commit of the checkout that a file belongs to, and whether it has been changed since.

    Both are None if Git does not know the file: an installed package may lie in somebody else's
    checkout.

    Examples:
        >>> commit_of(Path("/nowhere/module.py"))
        (None, None)
    """
    known = _git(file.parent, "ls-files", "--error-unmatch", file.name)
    said = known and _git(
        file.parent, "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty"
    )
    if not said:
        return None, None
    return said.removesuffix("-dirty"), said.endswith("-dirty")


def _git(directory: Path, *arguments: str) -> str:
    """What Git answers, without the line's end; nothing if it does not, for whatever reason."""
    environment = {name: value for name, value in os.environ.items() if name not in _CLEARED}
    try:
        result = subprocess.run(
            ["git", *arguments],
            cwd=directory, env={**environment, "GIT_OPTIONAL_LOCKS": "0"}, timeout=_PATIENCE,
            stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return ""
    return result.stdout.strip()


def _read(path: Path) -> list[dict[str, Any]]:
    try:
        return [entry for entry in json.loads(path.read_text()) if entry["steps"] >= 0]
    except (OSError, ValueError, TypeError, KeyError):
        return []
