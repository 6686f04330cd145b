"""Checks of a run's settings that nothing else would make before it has begun."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra.errors import InstantiationException
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import CheckpointError

__all__ = ["SettingError", "check_settings", "errors_in_a_line"]


class SettingError(ValueError):
    """A value that a run cannot have; the message names the key."""


class _Row(NamedTuple):
    key: str
    holds: Callable[[Any], bool]
    meaning: str


def _is_count(lowest: int) -> Callable[[Any], bool]:
    return lambda value: _is_number(value) and value >= lowest and float(value).is_integer()


def _is_number(value: Any) -> bool:
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    return is_real and math.isfinite(value)


_ROWS = (
    _Row("frames", _is_count(1), "a number of steps, at least 1"),
    _Row("frames_per_batch", _is_count(1), "a number of steps, at least 1"),
    _Row("num_envs", _is_count(1), "a number of environments, at least 1"),
    _Row("seed", _is_count(0), "a whole number, at least 0"),
    _Row("checkpoint.interval", lambda v: _is_number(v) and v >= 0, "a number of seconds"),
    _Row("checkpoint.keep_last", _is_count(1), "a number of checkpoints, at least 1"),
    _Row("num_threads", lambda v: v is None or _is_count(1)(v), "a number of threads, or null"),
    _Row(
        "model.hidden_sizes",
        lambda v: OmegaConf.is_list(v) and all(map(_is_count(1), v)),
        "a list of widths, such as [64, 64]",
    ),
    _Row("cost_limits", OmegaConf.is_dict, "limits by cost: cost_limits='{cost: 25}'"),
)


def check_settings(config: DictConfig) -> None:
    """Check the types and ranges of what every run has.

    Args:
        config: Configuration as composed from ``conf/``.

    Raises:
        SettingError: For the first value that cannot be.
    """
    for row in _ROWS:
        value = OmegaConf.select(config, row.key)
        if not row.holds(value):
            raise SettingError(f"{row.key}={value}: it must be {row.meaning}.")
    try:
        kind = torch.device(config.device).type
    except RuntimeError as error:
        raise SettingError(f"device={config.device}: {error}") from None
    if kind == "cuda" and not torch.cuda.is_available():
        raise SettingError(f"device={config.device}: this torch finds no CUDA device.")


@contextmanager
def errors_in_a_line(directory: Path, is_new: bool, *also: type[Exception]) -> Iterator[None]:
    """End with what is wrong instead of the way to it, which ``HYDRA_FULL_ERROR=1`` shows.

    Args:
        directory: Folder of the run.
        is_new: Whether it may go if nothing but Hydra's notes is in it.
        also: Errors about settings besides `ValueError`, `CheckpointError` and Hydra's.

    Raises:
        SystemExit: For errors about settings and files; all others pass.
    """
    try:
        yield
    except (ValueError, CheckpointError, InstantiationException, *also) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        if is_new and all(path.name == ".hydra" for path in directory.iterdir()):
            shutil.rmtree(directory)
        raise SystemExit(_in_words(error)) from None


def _in_words(error: Exception) -> str:
    """A component's own words, and the key of the component."""
    cause = error.__cause__
    if isinstance(error, InstantiationException) and cause is not None:
        key = str(error).rpartition("full_key: ")[2]
        words = str(cause) if isinstance(cause, ValueError) else f"{type(cause).__name__}: {cause}"
        return f"{key}: {words}"
    return str(error)
