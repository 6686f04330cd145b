"""Certificates of runs: at the end of training, and afterwards by ``evaluate RUN certify=true``."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.conf import CONF
from safe_rl.cli.robots import maker_of
from safe_rl.evaluation import Certificate, CertificateOptions, certify
from safe_rl.evaluation.loading import load_config

__all__ = ["certify_run", "is_worth_a_certificate"]


def certify_run(
    directory: Path, *, num_threads: int = 0, progress: bool = True
) -> Certificate | None:
    """:func:`safe_rl.evaluation.certify` with the options of the run's own configuration.

    Runs of before there were certificates get the package's options.
    """
    options = dict(OmegaConf.load(CONF / "config.yaml").certificate)
    options |= load_config(directory).get("certificate") or {}
    return certify(
        directory,
        CertificateOptions(**options),
        make_env=maker_of(directory),
        num_threads=num_threads,
        progress=progress,
    )


def is_worth_a_certificate(config: DictConfig, episode_length: int) -> bool:
    """Whether a run is longer than the test by which it would be certified."""
    episodes = config.certificate.episodes if "certificate" in config else 0
    return 0 < episodes * episode_length <= config.frames
