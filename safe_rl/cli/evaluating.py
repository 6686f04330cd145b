"""Evaluate or certify a trained policy, or run it under variations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, get_type_hints

from omegaconf import DictConfig, OmegaConf

from safe_rl.checks import check_value
from safe_rl.cli.report import suite
from safe_rl.cli.run_folders import maker_of
from safe_rl.evaluation import (
    Certificate,
    CertificateOptions,
    Evaluation,
    EvaluationOptions,
    certify,
    evaluate,
)
from safe_rl.evaluation.policies import writable_copy
from safe_rl.evaluation.variations import Varied, evaluate_variations
from safe_rl.files import CONF
from safe_rl.naming import did_you_mean
from safe_rl.reporting.figures import draw_variations
from safe_rl.runs.run import Run


def evaluate_run(
    directory: Path, options: EvaluationOptions, *, progress: bool = False
) -> Evaluation:
    """:func:`safe_rl.evaluation.evaluate` with this package's environments and benchmark.

    Raises:
        ValueError: If the options ask for a certificate or for variations.
    """
    directory = writable_copy(directory)
    if options.certify or options.variations is not None:
        raise ValueError("evaluate: certificates are made by certify(), variations by vary(…).")
    make = maker_of(directory)
    return evaluate(directory, options, make_env=make, suite=suite(), progress=progress)


def certify_run(
    directory: Path,
    *,
    num_threads: int = 0,
    changes: Mapping[str, Any] | None = None,
    deterministic: bool = False,
) -> Certificate | None:
    """:func:`safe_rl.evaluation.certify` with the options of the run, some of them changed."""
    options = certificate_options(Run(directory).config, changes)
    options = replace(options, deterministic=deterministic)
    make = maker_of(directory)
    certificate = certify(directory, options, make_env=make, num_threads=num_threads, progress=True)
    Run(directory).certifying_file.unlink(missing_ok=True)
    return certificate


def certificate_options(
    config: DictConfig, changes: Mapping[str, Any] | None = None
) -> CertificateOptions:
    """The options of a run's certificate, from its sections ``certificate`` and ``risk``.

    With ``risk=chance`` the share of episodes above the limit is certified as well; with
    ``risk=cvar`` the mean cost of the costliest episodes.
    """
    options = dict(config.certificate)
    kinds = get_type_hints(CertificateOptions, include_extras=True)
    for name, value in (changes or {}).items():
        if name not in options:
            raise ValueError(f"There is no certificate.{name}.{did_you_mean(name, options)}")
        options[name] = check_value(f"certificate.{name}", kinds[name], value)
    if not options["episodes"]:  # training was to end without a certificate
        options["episodes"] = OmegaConf.load(CONF / "config.yaml").certificate.episodes
    # with risk=mean the section may still have numbers, such as the tail of WCSAC's critics
    risk = config.risk if OmegaConf.select(config, "risk._target_") else {}
    share = min(options["most_over"], risk.get("most_over", 1.0))
    return CertificateOptions(**options | {"most_over": share}, tail=risk.get("tail", 1.0))


def evaluate_varied(
    directory: Path, options: EvaluationOptions, *, progress: bool = False
) -> tuple[Varied, Path]:
    """Run a policy under ``options.variations``, and write a table and a picture.

    Returns:
        The results, and the path of the picture.
    """
    directory = writable_copy(directory)
    make = maker_of(directory)
    found = evaluate_variations(directory, options, make_env=make, progress=progress)
    picture = Run(directory).variations_file(options.name, "png")
    draw_variations(found.rows, found.cost_limits, picture)
    return found, picture
