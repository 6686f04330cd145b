"""Which runs continue, which are finished, and what may change in between."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra.conf import HydraConf
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from safe_rl.runs.checkpoints import CheckpointStore

__all__ = ["check_same_run", "is_finished", "may_continue"]

_MAY_CHANGE = ("frames", "num_threads", "device", "compile", "checkpoint", "logger")


def may_continue(hydra: HydraConf, config: DictConfig) -> bool:
    """Whether a run that is in the output folder already is to be continued.

    That is so where the configuration comes from the folder itself, which is how ``resume=`` calls
    Hydra, and for the jobs of a sweep, whose folders follow from their overrides.

    Raises:
        ValueError: If the folder of a sweep's job holds a run with other settings.
    """
    output = Path(hydra.runtime.output_dir).resolve()
    if hydra.mode is RunMode.MULTIRUN:
        check_same_run(output, config)
        return True
    sources = {Path(s.path).resolve() for s in hydra.runtime.config_sources if s.provider == "main"}
    return output in sources


def is_finished(directory: Path, frames: int) -> bool:
    """Whether the run in a folder has come to its end."""
    return CheckpointStore.newest_step(directory / "checkpoints") >= frames


def check_same_run(directory: Path, config: DictConfig) -> None:
    """Refuse to continue a run under another configuration; how long and where may change.

    Raises:
        ValueError: Naming every key that differs.
    """
    path = directory / "config.yaml"
    if not path.is_file():
        return
    saved, given = (_settings(node) for node in (OmegaConf.load(path), config))
    keys = [key for key in sorted({*saved, *given}) if saved.get(key) != given.get(key)]
    if keys:
        changes = ", ".join(f"{key}: {saved.get(key)} -> {given.get(key)}" for key in keys)
        raise ValueError(
            f"{directory} holds a run with other settings ({changes}). Move it away, or give the "
            "sweep another folder with hydra.sweep.dir=..."
        )


def _settings(config: Any) -> dict[str, Any]:
    """Every value by its dotted key, without those that may change."""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    return dict(_flatten({key: plain[key] for key in plain if key not in _MAY_CHANGE}))


def _flatten(node: Mapping[Any, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
