"""One training run: its configuration, its table and its other files."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from safe_rl.checks import is_number
from safe_rl.reporting.tables import clean
from safe_rl.runs.folder import checkpoint_steps
from safe_rl.runs.outcome import final_figures, judges_another_measure, violation


@dataclass(frozen=True)
class Run:
    """One training run.

    Attributes:
        directory: Its folder; for an archived run, its name below the archive.
        config: Its configuration, resolved.
        table: Columns of its table; a row per epoch, NaN where there is no number.
        notes: ``overrides``, ``certificate``, ``code`` and so on, as in its files.
        takes_part: Whether it counts as finished before it has reached its end.
    """

    directory: Path
    config: Mapping[str, Any]
    table: Mapping[str, list[float]]
    notes: Mapping[str, Any] = field(default_factory=dict)
    takes_part: bool = False

    def check(self) -> None:
        """Refuse a run that lacks what a report needs.

        Raises:
            ValueError: If the configuration or the table lacks something.
            Exception: Of any type, if notes are not as a run writes them.
        """
        frames, limits = self.config.get("frames", -1), self.config.get("cost_limits") or {}
        usable = {
            "env": isinstance(self.config.get("env"), dict),
            "algo": isinstance(select(self.config, "algo", "name"), str),
            "seed": type(self.config.get("seed")) is int,
            "frames": is_number(frames) and frames >= 0,
            "cost_limits": isinstance(limits, dict) and all(map(is_number, limits.values())),
            "init_from": isinstance(self.config.get("init_from"), str | None),
        }
        if wrong := ", ".join(key for key, is_usable in usable.items() if not is_usable):
            raise ValueError(f"config.yaml is not that of a run: it lacks a usable {wrong}")
        if not self.table.get("steps"):
            raise ValueError("it has not finished an epoch")
        needed = ["episode_return", "time_total"]
        needed += [name for key in limits for name in (f"episode_{key}", f"{key}_rate")]
        if missing := [name for name in needed if name not in self.table]:
            raise ValueError(f"progress.csv has no column {missing[0]}")
        steps = np.array([0.0, *self.table["steps"]])
        if not (np.isfinite(steps).all() and (np.diff(steps) > 0).all() and self.hours > 0):
            raise ValueError("progress.csv cannot be read (its steps or times do not grow)")
        for name in ("command", "evaluations", "certificate", "code"):
            getattr(self, name)

    @property
    def seed(self) -> int:
        """Seed of networks, layouts and actions."""
        return self.config["seed"]

    @property
    def algorithm(self) -> str:
        """Name of the file in ``conf/algo``."""
        return self.config["algo"]["name"]

    @property
    def limits(self) -> dict[str, float]:
        """Cost key -> d, undiscounted cost per episode."""
        return {key: float(d) for key, d in (self.config.get("cost_limits") or {}).items()}

    @property
    def episode_length(self) -> int | None:
        """T_ep in steps, or None if the configuration does not have it."""
        found = (self.config["env"].get(key) for key in ("num_steps", "max_episode_steps"))
        return next((n for n in found if isinstance(n, int) and n > 0), None)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.table["steps"][-1])

    @property
    def length(self) -> int:
        """The configured number of environment steps; for an unfinished run, those so far."""
        configured = self.config["frames"]
        return int(configured) if 0 < configured <= self.steps else self.steps

    @property
    def is_finished(self) -> bool:
        """Whether it counts as finished."""
        return self.takes_part or self.steps >= self.config["frames"]

    @property
    def hours(self) -> float:
        """Time of training so far [h]."""
        return self.table["time_total"][-1] / 3600

    @property
    def overrides(self) -> list[str] | None:
        """The overrides of its command line, or None if they are not recorded."""
        said = self.notes.get("overrides")
        return [clean(override) for override in said] if isinstance(said, list) else None

    @property
    def command(self) -> str | None:
        """The command that repeats it, or None if its overrides are not recorded."""
        overrides = self.overrides
        if overrides is None:
            return None
        if isinstance(self.notes.get("frames_before"), int):  # it was continued for longer
            kept = [override for override in overrides if not override.startswith("frames=")]
            overrides = [*kept, f"frames={self.config['frames']}"]
        folders = [f"--config-dir={clean(path)}" for path in self.notes.get("config_dirs", ())]
        return shlex.join(["python", "train.py", *folders, *overrides])

    @cached_property
    def evaluations(self) -> list[dict[str, Any]]:
        """Its evaluations, each as a record, see `read_evaluation`."""
        return [read_evaluation(found) for found in self.notes.get("evaluations", ())]

    @cached_property
    def certificate(self) -> dict[str, Any] | None:
        """Its certificate as a record, see `read_certificate`, or None."""
        return read_certificate(self.notes["certificate"]) if "certificate" in self.notes else None

    @cached_property
    def code(self) -> str | None:
        """The version and commit of its code, see `read_code`, or None."""
        return read_code(self.notes["code"]) if "code" in self.notes else None

    def column(self, name: str) -> np.ndarray:
        """A column in the epochs in which an episode finished, shape [epochs]; NaN if missing."""
        known = np.isfinite(self.table["episode_return"])
        return np.array(self.table.get(name, [math.nan] * known.size), dtype=float)[known]

    def final(self, cost_keys: Sequence[str]) -> dict[str, float]:
        """Final J_r, J_c and ρ_c by column name (section 5.1), for the costs that it has."""
        return final_figures(self.table, [key for key in cost_keys if f"{key}_rate" in self.table])

    def excess(self, key: str) -> float:
        """Violation of a cost's limit, a mean over the last epochs; negative within it."""
        return violation(self.final([key]), key, self.limits[key])

    def limits_another_measure(self, key: str) -> bool:
        """Whether the limit of a cost is on another measure than the mean cost of an episode."""
        return judges_another_measure(self.table, key, self.limits[key])


def read_certificate(content: Mapping[str, Any]) -> dict[str, Any]:
    """A certificate as a record of tables; any exception if the content is no certificate.

    Its ``checkpoint`` is the number of steps, or None if no policy is certified. ``bound_<name>``
    is the upper bound on a mean, and ``most_<name>`` its limit.
    """
    checkpoint, bounds = content["checkpoint"], content["bounds"]
    return {
        "certified": "no" if checkpoint is None else "yes",
        "surely": f"{100 * content['level']:.12g}%",  # not rounded up to 100
        "checkpoint": None if checkpoint is None else checkpoint_steps(Path(str(checkpoint))),
        "certified_return": _number(content["episode_return"]),
        "episodes": int(content["episodes"]),
        "level": float(content["level"]),
        **{f"bound_{name}": _number(bound["bound"]) for name, bound in bounds.items()},
        **{f"most_{name}": _number(bound["most"]) for name, bound in bounds.items()},
    }


def read_evaluation(content: Mapping[str, Any]) -> dict[str, Any]:
    """An evaluation as a record of tables: every estimate and the bounds of its interval."""
    manner = [str(content["name"])] if content.get("name") else []
    manner.append("mean actions" if content["deterministic"] else "sampled actions")
    manner += [f"{key}={value}" for key, value in content["env"].items()]
    manner.append(f"{content['layouts_trained_on']:.0%} known layouts")
    record = {
        "checkpoint": clean(content["checkpoint"]),
        "steps": content["steps"],
        "episodes": int(content["episodes"]),
        "cvar_alpha": float(content["cvar_alpha"]),
        "manner": clean(", ".join(manner)),
        **{f"limit_{key}": float(d) for key, d in content["cost_limits"].items()},
    }
    for name, estimate in content["estimates"].items():
        for part, suffix in (("value", ""), ("low", "_low"), ("high", "_high")):
            record[f"{name}{suffix}"] = _number(estimate[part])
    return record


def read_code(content: Sequence[Mapping[str, Any]]) -> str:
    """The version and commit of a run's code; of later ones, also the steps at which they began."""
    parts = []
    for entry in content[:9]:
        words = [clean(entry["version"], 20), clean(entry["commit"] or "")[:10]]
        words += ["with changes"] if entry["changed"] else []
        words += [f"from {int(entry['steps']):,} steps on"] if entry["steps"] else []
        parts.append(" ".join(filter(None, words)))
    return "; ".join(parts)


def select(node: Any, *keys: str) -> Any:
    """The value at a path of keys in nested mappings, or None."""
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
