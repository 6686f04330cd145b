"""Which runs continue, which are finished, and what may change in between."""

from __future__ import annotations

from pathlib import Path

from hydra.conf import HydraConf
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from safe_rl.runs.checkpoints import CheckpointStore
from safe_rl.runs.files import read_config
from safe_rl.runs.folder import RunFolder
from safe_rl.runs.identity import differences

__all__ = ["check_same_run", "is_finished", "may_continue"]


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
    return CheckpointStore.newest_step(RunFolder(directory).checkpoints) >= frames


def check_same_run(directory: Path, config: DictConfig) -> None:
    """Refuse to continue a run under another configuration; how long and where may change.

    Raises:
        ValueError: Naming every key that differs.
    """
    run = RunFolder(directory)
    if not run.is_run:
        return
    given = OmegaConf.to_container(config, resolve=True)
    assert isinstance(given, dict)
    found = differences(read_config(run.config), given)  # type: ignore[arg-type]
    if found:
        changes = ", ".join(f"{key}: {before} -> {now}" for key, (before, now) in found.items())
        raise ValueError(
            f"{directory} holds a run with other settings ({changes}). Move it away, or give the "
            "sweep another folder with hydra.sweep.dir=..."
        )
