"""What evaluations, certificates and notes on the code say, with the types that tables need."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from safe_rl.reporting.cleaning import clean
from safe_rl.runs.folder import checkpoint_steps

__all__ = ["read_certificate", "read_code", "read_evaluation"]

_LETTERS = 10  # of a commit's name


def read_evaluation(path: Path) -> dict[str, Any] | None:
    """Read an evaluation; None if the file is something else.

    Raises:
        ValueError: If it is none.
        OSError: If it cannot be read.
    """
    with _content(path, "it is no evaluation") as content:
        if "estimates" not in content:
            return None
        return {
            "name": clean(content.get("name") or "", 60),
            "checkpoint": clean(content["checkpoint"]),
            "steps": content["steps"],
            "episodes": int(content["episodes"]),
            "deterministic": bool(content["deterministic"]),
            "env": {clean(key): clean(value) for key, value in content["env"].items()},
            "layouts_trained_on": float(content["layouts_trained_on"]),
            "cvar_alpha": float(content["cvar_alpha"]),
            "cost_limits": {str(k): float(d) for k, d in content["cost_limits"].items()},
            "estimates": {
                name: {part: _number(estimate[part]) for part in ("value", "low", "high")}
                for name, estimate in content["estimates"].items()
            },
        }


def read_certificate(path: Path) -> dict[str, Any]:
    """Read a certificate; a run without a certified checkpoint has None for it.

    Raises:
        ValueError: If it is none.
        OSError: If it cannot be read.
    """
    with _content(path, "it is no certificate") as content:
        checkpoint = content["checkpoint"]
        return {
            "checkpoint": None if checkpoint is None else checkpoint_steps(Path(str(checkpoint))),
            "certified_return": _number(content["episode_return"]),
            "bounds": {
                clean(name): (_number(bound["bound"]), _number(bound["most"]))
                for name, bound in content["bounds"].items()
            },
            "episodes": int(content["episodes"]),
            "level": float(content["level"]),
        }


def read_code(path: Path) -> str:
    """By which code a run was carried out, and from which step on by which other one.

    Raises:
        ValueError: If the file does not say it.
        OSError: If it cannot be read.
    """
    with _content(path, "it says nothing of the code") as entries:
        return "; ".join(map(_code, entries[:9]))


@contextmanager
def _content(path: Path, otherwise: str) -> Iterator[Any]:
    """What a JSON file holds; whatever goes wrong with it, also in the block, is said in words."""
    try:
        yield json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{otherwise} ({type(error).__name__}: {error})") from error


def _code(entry: dict[str, Any]) -> str:
    commit = clean(entry["commit"] or "")[:_LETTERS]
    words = [clean(entry["version"], 20), *filter(None, [commit])]
    words += ["with changes"] if entry["changed"] else []
    words += [f"from {int(entry['steps']):,} steps on"] if entry["steps"] else []
    return " ".join(words)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
