"""A run: its folder, configuration, table, checkpoints, certificate and outcome.

Training writes these files; evaluation, Python and the report read them. No other module contains
their names.
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from safe_rl.files import read_bounded, read_config, read_json, read_yaml
from safe_rl.runs.folder import checkpoints_in, paths_below, run_of
from safe_rl.runs.identity import measure_of, unusable_keys
from safe_rl.runs.table import MOST_BYTES, final_figures, measured, outcome_line, read_table

KINDS = ("last", "best", "certified")
"""Folders of checkpoints: the newest, the best that kept every limit, the certified one."""


class Run:
    """One training run.

    Contents are read when they are first asked for, without trusting the files.

    Args:
        directory: Its folder, which need not exist.
        contents: ``settings`` and ``table`` that have been read already, such as an archive's.

    Attributes:
        directory: Its folder; for an archived run, its name below the archive.

    Examples:
        >>> run = Run(Path("runs/mine"), settings={"seed": 3, "cost_limits": {"cost": 25}})
        >>> run.table_file.as_posix(), run.evaluation_file("many", "json").name
        ('runs/mine/progress.csv', 'evaluation_many.json')
        >>> run.seed, run.cost_limits
        (3, {'cost': 25.0})
    """

    def __init__(self, directory: Path | str, **contents: Any) -> None:
        folder = self.directory = Path(directory)
        self.config_file = folder / "config.yaml"  # resolved
        self.table_file = folder / "progress.csv"  # a row per epoch
        self.curves_file = folder / "curves.png"  # the picture of its learning curves
        self.failure_file = folder / "failure.txt"  # traceback of a failed job of a sweep
        self.lock_file = folder / ".lock"  # keeps a second process from writing; names the first
        self.robot_folder = folder / "robot"  # copies of the files of a user's own robot
        self.robot_file = folder / "robot.json"  # which robot that is, and its SHA-256
        self.notes_folder = folder / ".hydra"  # Hydra's notes:
        self.overrides_file = self.notes_folder / "overrides.yaml"  # of the command line
        self.hydra_file = self.notes_folder / "hydra.yaml"  # also where the command was run
        self.composed_file = self.notes_folder / "config.yaml"  # before it was resolved
        self.code_file = folder / "code.json"  # versions of the code
        self.checkpoints_folder = folder / "checkpoints"  # a folder for each of `KINDS`
        self.transitions_folder = folder / "transitions"  # if they were recorded
        self.certificate_file = folder / "certificate.json"  # which checkpoint is certified
        self.tests_file = folder / "certificate_tests.json"  # the error that its tests have spent
        # cached properties that are known already, as those of an archived run, which has no files
        vars(self).update(contents)

    # files

    def checkpoints(self, kind: str) -> list[Path]:
        """Checkpoints of a kind by ascending steps, readable or not."""
        return checkpoints_in(self.checkpoints_folder / kind)

    def newest_checkpoint(self, kind: str = "last") -> Path | None:
        """The checkpoint of a kind with most steps, readable or not; None if there is none."""
        return next(reversed(self.checkpoints(kind)), None)

    def evaluation_file(self, name: str, suffix: str) -> Path:
        """A file of an evaluation by its suffix, such as ``json`` or ``mp4``."""
        return self.directory / f"evaluation{name and f'_{name}'}.{suffix}"

    def logger_id_file(self, logger: str) -> Path:
        """The file with the id of this run in a logger's service."""
        return self.directory / f"{logger}_run_id.txt"

    def find_checkpoint(self, which: str) -> Path:
        """The path of a checkpoint: "last", "best", "certified", or a path.

        Raises:
            FileNotFoundError: If there is none; the message says why and what there is.
            ValueError: If it is another run's.
        """
        if which not in KINDS:
            if not Path(which).exists():
                raise FileNotFoundError(
                    f"There is no checkpoint '{which}': checkpoint is last, best, certified or the "
                    "path of a file."
                )
            owner = Run(run_of(Path(which))[0])
            if owner.is_run and owner.settings != self.settings:  # a copy of a run has the same
                raise ValueError(
                    f"{which} is a checkpoint of another run, {owner.directory}: name that run."
                )
            return Path(which)
        from safe_rl.runs.checkpoints import best_checkpoint  # it needs torch

        # the newest one, even if it cannot be read: an older one must not silently replace it
        newest = {kind: self.newest_checkpoint(kind) for kind in KINDS}
        newest["best"] = best_checkpoint(self.checkpoints_folder / "best")
        path = self._certified() if which == "certified" else newest[which]
        if which == "last" and not self.has_begun:  # only a policy, see `pack_policy`
            path = path or newest["certified"]
        if path is None:
            reason = {
                "last": "it has not saved one yet",
                "best": "in no epoch did episodes end that kept every cost limit, with "
                "estimate_<cost> ≤ target_<cost>",
                "certified": "none of its policies has been certified",
            }
            others = (kind for kind, path in newest.items() if kind != which and path is not None)
            hint = "".join(f" Use checkpoint={other}." for other in [*others][:1])
            raise FileNotFoundError(
                f"{self.directory} has no {which} checkpoint: {reason[which]}.{hint}"
            )
        return path

    def _certified(self) -> Path | None:
        """The checkpoint that the certificate is about; None if it is gone."""
        name = (self.certificate or {}).get("checkpoint")
        path = self.checkpoints_folder / "certified" / Path(str(name)).name
        if name is None or not path.exists():
            return None
        if self.certificate_of(path) is None:
            raise ValueError(
                f"{path} is not the policy that {self.certificate_file.name} is about: certify it "
                "again."
            )
        return path

    def certificate_of(self, checkpoint: Path) -> dict[str, Any] | None:
        """The certificate if it is about the policy in this file; None otherwise."""
        content = self.certificate or {}
        certified = self.checkpoints_folder / "certified" / str(content.get("checkpoint"))
        if not checkpoint.is_file() or checkpoint.resolve() != certified.resolve():
            return None
        from safe_rl.runs.checkpoints import policy_hash  # it needs torch

        expected = content.get("policy_sha256")
        return content if expected in (None, policy_hash(checkpoint)) else None

    @property
    def evaluation_files(self) -> list[Path]:
        """The files with the estimates of all evaluations."""
        return sorted(self.directory.glob("evaluation*.json"))

    @property
    def is_run(self) -> bool:
        """Whether a run has been set up here."""
        return self.config_file.is_file()

    @property
    def has_begun(self) -> bool:
        """Whether a run has a table here."""
        return self.table_file.exists()

    @property
    def num_rows(self) -> int:
        """Finished epochs in the table."""
        try:
            lines = read_bounded(self.table_file, MOST_BYTES).count(b"\n")
        except FileNotFoundError:
            return 0
        return max(0, lines - 1)

    def check_is_run(self) -> None:
        """Refuse a folder that is not a run's by a FileNotFoundError, which names runs below it."""
        if self.is_run:
            return
        # of a home, or of a whole disk, a search would take minutes
        below = [str(run.directory) for run in find_runs(self.directory, most=1_000)[:5]]
        hint = f" Runs below it: {', '.join(below)}." if below else ""
        raise FileNotFoundError(
            f"{self.directory} is not the folder of a run: no {self.config_file.name}.{hint}"
        )

    # configuration

    @cached_property
    def settings(self) -> dict[str, Any]:
        """Its configuration as plain dictionaries.

        Raises:
            FileNotFoundError: If the folder is not that of a run.
            ValueError: If the file is not the resolved configuration of a run.
        """
        self.check_is_run()
        settings = read_config(self.config_file)
        if wrong := ", ".join(unusable_keys(settings)):
            raise ValueError(
                f"{self.config_file} is not the configuration of a run: it lacks a usable {wrong}."
            )
        return settings

    @cached_property
    def config(self) -> DictConfig:
        """Its whole configuration."""
        return OmegaConf.create(self.settings)

    @property
    def seed(self) -> int:
        """Seed of networks, layouts and actions."""
        return self.settings["seed"]

    @property
    def algorithm(self) -> str:
        """Name of the algorithm, as of its file in ``conf/algo``."""
        return self.settings["algo"]["name"]

    @property
    def environment(self) -> str:
        """Name of the environment."""
        return str(self.settings["env"].get("name", "environment"))

    @property
    def cost_limits(self) -> dict[str, float]:
        """Cost key -> d, undiscounted cost per episode."""
        return {key: float(d) for key, d in (self.settings.get("cost_limits") or {}).items()}

    @property
    def measure(self) -> str:
        """Which measure of episode costs is limited: ``mean``, or the class of the risk measure."""
        return measure_of(self.settings)

    @property
    def episode_length(self) -> int | None:
        """T_ep in steps, or None if the configuration does not have it."""
        lengths = (self.settings["env"].get(key) for key in ("num_steps", "max_episode_steps"))
        return next((n for n in lengths if type(n) is int and n > 0), None)

    @cached_property
    def overrides(self) -> list[str] | None:
        """Overrides of its command line, or None if they are not recorded."""
        if not self.overrides_file.is_file():
            return None
        words = read_yaml(self.overrides_file)
        return [str(word) for word in words] if isinstance(words, list) else None

    # table and outcome

    @cached_property
    def table(self) -> dict[str, list[float]]:
        """The columns of ``progress.csv``; NaN in epochs in which no episode ended."""
        if not self.table_file.exists():
            raise FileNotFoundError(
                f"{self.directory} has no progress.csv: an exported policy has no table."
            )
        return read_table(self.table_file)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.table["steps"][-1])

    @cached_property
    def is_finished(self) -> bool:
        """Whether it has its configured number of steps."""
        return self.steps >= self.settings["frames"]

    @property
    def hours(self) -> float:
        """Time of training so far [h]."""
        return self.table["time_total"][-1] / 3600

    def column(self, name: str) -> np.ndarray:
        """A column in the epochs in which an episode finished, shape [epochs]; NaN if missing."""
        known = np.isfinite(self.table["episode_return"])
        return np.array(self.table.get(name, [np.nan] * known.size), dtype=float)[known]

    def figures(self, cost_keys: list[str]) -> dict[str, float]:
        """Final J_r, J_c and ρ_c by column name (section 5.1), for the costs that it has."""
        return final_figures(self.table, [key for key in cost_keys if f"{key}_rate" in self.table])

    @property
    def final(self) -> dict[str, float]:
        """Final J_r (``episode_return``), J_c (``episode_<cost>``) and ρ_c (``<cost>_rate``)."""
        return self.figures(list(self.cost_limits) or ["cost"])

    @property
    def outcome(self) -> str:
        """One line about its end: return and costs over its last epochs."""
        return outcome_line(self.table, self.cost_limits, self.episode_length, self.measure)

    def excess(self, key: str) -> float:
        """Excess of the limited measure over its limit, a mean over the last epochs."""
        limit = self.cost_limits[key]
        return measured(self.figures([key]), key, limit, self.measure) - limit

    def limits_another_measure(self, key: str) -> bool:
        """Whether the limit of a cost is on another measure than the mean cost of an episode."""
        return self.measure != "mean" and f"violation_{key}" in self.table

    # certificate, evaluations, code

    @property
    def certificate(self) -> dict[str, Any] | None:
        """The content of ``certificate.json``, or None if there is no such file."""
        if not self.certificate_file.is_file():
            return None
        content = read_json(self.certificate_file)
        if not isinstance(content, dict):
            raise ValueError(f"{self.certificate_file} is not as a run writes it.")
        return content

    @property
    def commit(self) -> Any:
        """The commit of the code that used it last; None if it is not known."""
        try:
            return read_json(self.code_file)[-1]["commit"]
        except (OSError, ValueError, TypeError, LookupError):
            return None  # there is no such file, or it is damaged


def find_runs(root: Path, most: int | None = None) -> list[Run]:
    """Runs below a folder, itself included, in the order of their paths; see `paths_below`."""
    names = Run(root)
    folders = (path.parent for path in paths_below(root, names.config_file.name, most))
    # Hydra and Weights & Biases write files of that name, too
    others = (names.notes_folder.name, "wandb/*run-*/files")
    return [Run(folder) for folder in folders if not any(map(folder.match, others))]
