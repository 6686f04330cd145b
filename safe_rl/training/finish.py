"""The end of a run: a signal that stops it, and the certificate of one that keeps limits."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from shlex import quote
from signal import SIGINT, Signals
from typing import Any

from omegaconf import DictConfig

from safe_rl.evaluation import Certificate, certify
from safe_rl.evaluation.certificate import has_options
from safe_rl.evaluation.policies import writable_copy
from safe_rl.evaluation.settings import certificate_options
from safe_rl.runs.folder import checkpoint_steps, lock_folder
from safe_rl.runs.run import Run


def certify_run(
    directory: Path | str,
    *,
    num_threads: int = 0,
    changes: Mapping[str, Any] | None = None,
    deterministic: bool = False,
) -> Certificate | None:
    """Certify the best checkpoint of a run that keeps its limits; no other process may write it.

    Args:
        directory: Folder of the run; a policy of the package is copied into the working directory.
        num_threads: Threads that step environments; 0 is one per core.
        changes: Keys of the section ``certificate`` to change.
        deterministic: Whether the policy acts with its mean actions.

    Returns:
        The certificate; None if the run has no limits or no checkpoints.

    Raises:
        RunInUseError: If another process writes into the folder.
        ValueError: If there is no such key, or it cannot have the value.
    """
    run = Run(writable_copy(Path(directory)))
    asked = {**(changes or {}), **({"deterministic": True} if deterministic else {})}
    options = certificate_options(run.config, asked)
    with lock_folder(run.lock_file):  # an unwritable folder is found before hours of tests
        return certify(run.directory, options, num_threads=num_threads, progress=True)


def certify_finished(
    run: Run,
    config: DictConfig,
    length: int,
    *,
    stopped_by: Signals | None,
    again: str,
    say: Callable[[str], None],
) -> None:
    """Certify a finished run that is to keep limits, unless it is short or tested already.

    A tested one is tested again if the configuration has other options for the test.

    Args:
        run: The run.
        config: Its configuration.
        length: T_ep, steps of a full episode.
        stopped_by: The signal that has come in the last epoch: it ends the process before the test.
        again: The command that continues the run.
        say: Prints a line.

    Raises:
        SystemExit: If a signal has come, or comes during the test.
    """
    # steps of a test that stops early, after a fifth of its episodes
    steps = int(config.certificate.episodes * length / 5)
    newest, certificate = run.newest_checkpoint(), run.certificate or {}
    tested = certificate.get("candidates") or ()
    is_tested = newest is not None and checkpoint_steps(newest) in tested
    # a certificate with the options of `safe-rl evaluate` stays if the run's own are unchanged
    is_unchanged = config.certificate == run.config.certificate
    has_same_options = is_unchanged or has_options(certificate, certificate_options(config))
    if not steps or (is_tested and has_same_options):
        return
    if steps > config.frames:
        given = "" if is_unchanged else f" certificate.episodes={config.certificate.episodes}"
        say(
            f"Not certified: frames={config.frames:_} are fewer than {steps:,}, a fifth of the "
            f"steps of certificate.episodes={config.certificate.episodes} episodes. To make a "
            "certificate all the same: safe-rl evaluate "
            f"{quote(str(run.directory))} certify=true{given}{import_words(config)}"
        )
        return
    later = f"Interrupted before it was certified. To do so: {again}"
    end_by(stopped_by, later)
    threads, changes = config.num_threads or 0, config.certificate
    try:
        result = certify_run(run.directory, num_threads=threads, changes=changes)
    except KeyboardInterrupt:
        return end_by(SIGINT, later)
    say(str(result))
    if result is not None and result.checkpoint is None:
        say(f"To train on: {again} frames={2 * config.frames:_}")


def import_words(config: DictConfig) -> str:
    """The words ``import=…`` of a run's modules, each after a space."""
    return "".join(f" import={quote(name)}" for name in config.get("import") or [])


def end_by(signal: Signals | None, line: str) -> None:
    """End the process if a signal asks for it, with a line about how to go on.

    Raises:
        SystemExit: If there is a signal; the status is 128 and its number.
    """
    if signal is not None:
        print_line(line)
        raise SystemExit(128 + signal)


def print_line(line: str) -> None:
    """Print a line, unless the terminal was closed; that may have ended the run."""
    try:
        print(line, flush=True)
    except OSError:
        # Python would flush the buffered line again at exit, and change the exit status
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
