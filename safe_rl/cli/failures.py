"""What is wrong with settings and files ends a command with one line."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra.errors import InstantiationException
from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import CheckpointError

from safe_rl.envs import ContractError
from safe_rl.runs.folder import RunFolder

__all__ = ["SETTING_ERRORS", "errors_in_a_line"]

SETTING_ERRORS: Collection[type[Exception]] = (
    *(ValueError, CheckpointError, InstantiationException, OmegaConfBaseException, OSError),
    *(ModuleNotFoundError, ContractError),
)
"""What goes wrong for the sake of settings and files while a run is built."""


@contextmanager
def errors_in_a_line(directory: Path, is_new: bool, *errors: type[Exception]) -> Iterator[None]:
    """End with what is wrong instead of the way to it, which ``HYDRA_FULL_ERROR=1`` shows.

    Args:
        directory: Folder of the run.
        is_new: Whether it may go if nothing is in it.
        errors: Errors that are about settings and files; all others pass.

    Raises:
        SystemExit: For these errors.
    """
    try:
        yield
    except errors as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        if is_new and directory.is_dir() and RunFolder(directory).is_untouched:
            shutil.rmtree(directory)
        raise SystemExit(_in_words(error)) from None


def _in_words(error: Exception) -> str:
    """A component's own words, and the key of the component, in one line."""
    cause = error.__cause__
    words = str(error)
    if isinstance(error, InstantiationException) and cause is not None:
        key = str(error).rpartition("full_key: ")[2]
        words = str(cause) if isinstance(cause, ValueError) else f"{type(cause).__name__}: {cause}"
        words = f"{key}: {words}"
    return " ".join(words.split())
