"""What runs note beside their tables, as records of tables: commands, certificates, evaluations.

Whatever a note has instead of what it should, reading it raises an error.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from safe_rl.reporting.tables import clean
from safe_rl.runs.folder import checkpoint_steps

__all__ = ["command_of", "read_certificate", "read_code", "read_evaluation", "select"]


def command_of(
    overrides: Sequence[str], notes: Mapping[str, Any], config: Mapping[str, Any]
) -> str:
    """The command line, with what it did not say in its overrides."""
    if isinstance(notes.get("frames_before"), int):  # it was continued for longer
        kept = [override for override in overrides if not override.startswith("frames=")]
        overrides = [*kept, f"frames={config['frames']}"]
    folders = [f"--config-dir={clean(path)}" for path in notes.get("config_dirs", ())]
    return shlex.join(["python", "train.py", *folders, *overrides])


def read_certificate(content: Mapping[str, Any]) -> dict[str, Any]:
    """A certificate as a record of tables.

    Its ``checkpoint`` is the number of steps, or None where no policy is certified;
    ``bound_<name>`` and ``most_<name>`` are the bound on a mean, and what it has to keep.
    """
    checkpoint, bounds = content["checkpoint"], content["bounds"]
    return {
        "checkpoint": None if checkpoint is None else checkpoint_steps(Path(str(checkpoint))),
        "certified_return": _number(content["episode_return"]),
        "episodes": int(content["episodes"]),
        "level": float(content["level"]),
        **{f"bound_{name}": _number(bound["bound"]) for name, bound in bounds.items()},
        **{f"most_{name}": _number(bound["most"]) for name, bound in bounds.items()},
    }


def read_evaluation(content: Mapping[str, Any]) -> dict[str, Any]:
    """An evaluation as a record of tables: every estimate and the ends of its interval."""
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
    """By which code a run was carried out, and from which step on by which other one."""
    parts = []
    for entry in content[:9]:
        words = [clean(entry["version"], 20), clean(entry["commit"] or "")[:10]]
        words += ["with changes"] if entry["changed"] else []
        words += [f"from {int(entry['steps']):,} steps on"] if entry["steps"] else []
        parts.append(" ".join(filter(None, words)))
    return "; ".join(parts)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def select(node: Any, *keys: str) -> Any:
    """What lies below keys of nested mappings; None where there is nothing."""
    for key in keys:
        node = node.get(key) if isinstance(node, dict) else None
    return node
