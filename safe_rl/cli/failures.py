"""Errors about settings and files end a command with one line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from omegaconf.errors import OmegaConfBaseException
from torchrl.checkpoint import CheckpointError

from safe_rl.cli.run_folders import remove_new
from safe_rl.envs import ContractError
from safe_rl.runs.folder import RunFolder

__all__ = ["SETTING_ERRORS", "errors_in_a_line"]

SETTING_ERRORS: tuple[type[Exception], ...] = (
    *(ValueError, CheckpointError, OmegaConfBaseException, OSError),
    *(ModuleNotFoundError, ContractError),
)
"""What is raised about settings and files, when a run is built or evaluated."""


@contextmanager
def errors_in_a_line(directory: Path, is_new: bool, *errors: type[Exception]) -> Iterator[None]:
    """End with the message of an error; ``HYDRA_FULL_ERROR=1`` shows its traceback, too.

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
            remove_new(directory)
        raise SystemExit(" ".join(str(error).split())) from None
