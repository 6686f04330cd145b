"""The command that repeats a run, as one would type it."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Sequence
from typing import Any

import yaml

from safe_rl.files import PROGRAM


def select(node: Any, *keys: str) -> Any:
    """The value at a path of keys in nested mappings, or None."""
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node


def config_dirs(notes: Any) -> list[str]:
    """Folders of ``--config-dir``, and of ``config_dir`` in Python, in Hydra's notes of a run.

    They are relative to the folder where the run was started, as the user has typed them.
    """
    runtime = select(notes, "hydra", "runtime")
    start, sources = select(runtime, "cwd"), select(runtime, "config_sources") or ()
    paths = [s["path"] for s in sources if s["provider"].endswith("command-line")]
    return [os.path.relpath(path, start) if start else path for path in paths]


def repeating(overrides: Sequence[str], folders: Iterable[str], frames: int | None = None) -> str:
    """The command that repeats a run.

    Args:
        overrides: Overrides that Hydra has noted.
        folders: Folders of ``--config-dir``.
        frames: The number of frames, if a run was continued to more than the overrides say.

    Examples:
        >>> words = ["import=['my_gym.py','mine']", "cost_limits={cost: 5}"]
        >>> repeating(words, ["conf"]).partition(" --")[2]
        "config-dir=conf import=my_gym.py import=mine 'cost_limits={cost: 5}'"
    """
    words = [f"--config-dir={folder}" for folder in folders]
    for word in overrides:
        key, _, value = word.partition("=")
        if key == "import":  # Hydra's notes have a list with quotes
            words += [f"import={name}" for name in yaml.safe_load(value)]
        elif frames is None or key != "frames":
            words.append(word)
    words += [] if frames is None else [f"frames={frames}"]
    return shlex.join([*PROGRAM.split(), *words])
