"""The command train.py in this process, and any program in one of its own."""

import os
import subprocess
import sys
from pathlib import Path

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig

from safe_rl.cli import train
from safe_rl.cli.composing import compose_run
from safe_rl.cli.config import check_settings

ROOT = Path(__file__).resolve().parents[1]
SMALL = (
    *("env.num_steps=20", "num_envs=2", "frames_per_batch=40", "logger=none", "num_threads=1"),
    "model.hidden_sizes=[8]",
)
"""Overrides of a run whose epochs are two short episodes."""


def status_of(*arguments: str) -> object:
    """Its exit status, or the line that it ends with."""
    try:
        train.main(arguments)
        return 0
    except SystemExit as end:
        return end.code


def composed(*words: str) -> list[DictConfig]:
    """The checked configurations that a command line begins runs with, at most four of a sweep."""
    given = get_args_parser().parse_args(train.prepare(words))
    folders = [given.config_dir] if given.config_dir else []
    name = given.config_name or "config"
    try:
        overrides = OverridesParser.create().parse_overrides(given.overrides)
        jobs = BasicSweeper.split_arguments(overrides, None)[0]
    except HydraException:
        jobs = [given.overrides]
    configs = [compose_run(job, folders, name) for job in jobs[:2] + jobs[2:][-2:]]
    for config in configs:
        check_settings(config)
    return configs


def run_train(*arguments: str) -> None:
    """A run that comes to its end."""
    assert status_of(*arguments) == 0


def in_a_process(*words: str, status: int = 0, cwd: Path = ROOT, **environment: str) -> str:
    """What Python prints with these arguments, ending with that status."""
    # this process has a policy because it has imported safe_rl
    outside = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    result = subprocess.run(
        [sys.executable, *words],
        cwd=cwd, env=outside | environment, capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    printed = result.stdout + result.stderr
    assert result.returncode == status, printed
    return printed
