"""``import=my_module``: a user's own code, on the command line and in workers.

A module may register environments, objects, costs and observations, and define what a ``_target_``
names. A run's configuration lists the modules under ``import``, but they are imported only if the
command names them: opening another person's run does not run their code.
"""

from __future__ import annotations

import shlex
import sys
import traceback
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from safe_rl import trust


def take_word(name: str, words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split words into the values of all ``name=value``, and the other words."""
    given = [word for word in words if word.lstrip("+").startswith(f"{name}=")]
    others = [word for word in words if word not in given]
    return [word.partition("=")[2] for word in given], others


def split_imports(words: Sequence[str]) -> tuple[list[str] | None, list[str]]:
    """Separate ``import=``, which may be repeated or hold a list, from the other words.

    Returns:
        The modules, or None if ``import=`` is not given; and the other words.
    """
    given, others = take_word("import", words)
    modules = [name.strip() for text in given for name in text.strip("[]").split(",")]
    return (list(dict.fromkeys(filter(None, modules))) if given else None), others


def import_modules(modules: str | Sequence[str] | None) -> None:
    """Import modules, and let configurations name what they define.

    Args:
        modules: One, several or None: dotted names, also of modules in the current directory, or
            paths of files.

    Raises:
        ValueError: If a module does not exist or cannot be imported, or if Python finds
            another module of the same name.
    """
    for module in [modules] if isinstance(modules, str) else modules or ():
        name, path = module, Path(f"{module.replace('.', '/')}.py")
        if module.endswith(".py"):
            path = Path(module).expanduser()
            name = path.stem
            if not path.is_file():
                raise ValueError(f"import={module}: there is no such file.")
        # the folder is added to the path: other processes import the module by its name
        folder = str(Path.cwd() if name == module else path.resolve().parent)
        if folder not in sys.path:
            sys.path.append(folder)
        loaded_from = _import(name, module)
        if path.is_file() and Path(loaded_from).resolve() != path.resolve():
            raise ValueError(
                f"import={module}: Python has another module of that name, "
                f"{loaded_from}. Rename yours."
            )
        trust.allow(name)


def _import(name: str, given: str) -> str:
    """Import a module; return its file, or "" if it has none."""
    try:
        return import_module(name).__file__ or ""
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name == name.partition(".")[0]:
            raise ValueError(
                f"import={given}: there is no module '{error.name}' here or among the installed "
                f"ones. A file is named by its path: import=folder/{error.name}.py."
            ) from None
        frames = traceback.extract_tb(error.__traceback__)
        # the user's own line, not the line of this package that refuses its arguments
        users = [frame for frame in frames if not _is_inner(frame.filename)]
        place = f" ({users[-1].filename}, line {users[-1].lineno})" if users else ""
        raise ValueError(f"import={given}: {type(error).__name__}: {error}{place}.") from error


def _is_inner(file: str) -> bool:
    """Whether code is of this package or of Python's import."""
    return file.startswith(str(Path(trust.__file__).parent)) or "importlib" in file


def check_imports(config: Mapping[Any, Any], given: str | Sequence[str] | None, run: Path) -> None:
    """Refuse to open a run that has used modules of its own, unless ``import=`` is given."""
    noted = config.get("import") or []
    if given is None and noted:
        words = shlex.join(f"import={module}" for module in noted)
        raise ValueError(
            f"{run} was trained with {words}: add that to the command if you trust this code, or "
            f"'import=[]' to go without. In Python: safe_rl.load(…, imports=[…])."
        )
