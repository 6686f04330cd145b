"""Certificates of runs: at the end of training, and afterwards by ``evaluate RUN certify=true``."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.run_folders import maker_of
from safe_rl.cli.schema import KEYS
from safe_rl.evaluation import Certificate, CertificateOptions, certify
from safe_rl.evaluation.loading import load_config
from safe_rl.files import CONF
from safe_rl.naming import did_you_mean
from safe_rl.runs.folder import RunFolder

__all__ = ["certificate_options", "certify_run", "is_to_keep_limits", "steps_of_test"]


def certify_run(
    directory: Path, *, num_threads: int = 0, changes: Mapping[str, Any] | None = None
) -> Certificate | None:
    """:func:`safe_rl.evaluation.certify` with the options of the run's own configuration.

    Args:
        directory: Folder of the run.
        num_threads: Threads that step environments; 0 is one per core.
        changes: Options to replace, such as ``{"episodes": 2000}``.

    Raises:
        ValueError: If an option does not exist, or cannot have its value.
    """
    certificate = certify(
        directory,
        certificate_options(load_config(directory), changes or {}),
        make_env=maker_of(directory),
        num_threads=num_threads,
        progress=True,
    )
    RunFolder(directory).certifying.unlink(missing_ok=True)
    return certificate


def certificate_options(
    config: DictConfig, changes: Mapping[str, Any] | None = None
) -> CertificateOptions:
    """What is certified of a run: what its section ``certificate`` says, and its limit on shares.

    What the run has limited is certified: with ``risk=chance`` the share of episodes above the
    limit, too, with ``risk=cvar`` the mean of the costliest ones.
    """
    options = dict(OmegaConf.load(CONF / "config.yaml").certificate)
    own = dict(config.get("certificate") or {})
    if not own.get("episodes", 1):  # the run was to end without a certificate
        del own["episodes"]
    options |= {name: value for name, value in own.items() if name in options}
    for name, value in (changes or {}).items():
        if name not in options:
            raise ValueError(
                f"There is no certificate.{name}.{did_you_mean(name, options)} There are: "
                f"{', '.join(options)}."
            )
        KEYS[f"certificate.{name}"].check(f"certificate.{name}", value)
        if name == "episodes" and not value:
            raise ValueError("certificate.episodes=0: it must be at least 1 to test anything.")
    options |= changes or {}
    risk = config.get("risk") or {}
    share = min(options["most_over"], risk.get("most_over", 1.0))
    return CertificateOptions(**options | {"most_over": share}, tail=risk.get("tail", 1.0))


def is_to_keep_limits(config: DictConfig, cost_keys: Collection[str]) -> bool:
    """Whether limits are kept by the algorithm, or by a transform that gives episodes a budget.

    Args:
        config: Configuration of the run.
        cost_keys: Costs that its algorithm constrains.
    """
    transforms = (config.get("transforms") or {}).values()
    return bool(cost_keys) or any("budgets" in transform for transform in transforms)


def steps_of_test(config: DictConfig, episode_length: int) -> int:
    """Steps of a test that ends early, after a fifth of its episodes; 0 if there is to be none."""
    return int(config.certificate.episodes * episode_length / 5) if "certificate" in config else 0
