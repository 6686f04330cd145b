"""What runs have recorded, and archives of it.

An archive has two files: ``runs.json.gz`` with a line per run, its configuration and its notes, and
``rows.csv.gz`` with the epochs of all runs, with the run in the first column.

Notes are what a run wrote beside its table: its command, certificate, evaluations and code. Their
readers raise an error for whatever a note has instead of what it should.
"""

from __future__ import annotations

import gzip
import json
import math
import os
import shlex
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from safe_rl.extras import import_extra
from safe_rl.files import replacing
from safe_rl.reporting.tables import clean
from safe_rl.runs.folder import checkpoint_steps

__all__ = [
    *("ROWS", "RUNS", "Recorded", "command_of", "read_archive", "read_certificate", "read_code"),
    *("read_evaluation", "select", "without_places", "write_archive"),
]

RUNS, ROWS = "runs.json.gz", "rows.csv.gz"


class Recorded(NamedTuple):
    """What a run has recorded, unchecked.

    Attributes:
        config: Its configuration, resolved.
        table: Columns of its table, a number per epoch.
        notes: ``overrides``, ``certificate``, ``code`` and the like, as its files have them.
    """

    config: Mapping[str, Any]
    table: Mapping[str, list[float]]
    notes: Mapping[str, Any]


def write_archive(runs: Mapping[str, Recorded], folder: Path) -> None:
    """Write runs by their names; the same runs make the same bytes.

    Examples:
        >>> folder, table = getfixture("tmp_path"), {"steps": [1000.0, 2000.0]}
        >>> run = Recorded({"seed": 0, "model": {"width": 64}}, table, {"overrides": ["seed=0"]})
        >>> write_archive({"a/seed0": run}, folder)
        >>> read_archive(folder)["a/seed0"] == run
        True
    """
    pandas = import_extra("pandas", "report")
    runs = dict(sorted(runs.items()))
    folder.mkdir(parents=True, exist_ok=True)
    entries = {name: {"config": run.config, **run.notes} for name, run in runs.items()}
    lines = [f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in entries.items()]
    tables = {name: pandas.DataFrame(run.table) for name, run in runs.items()}
    rows = pandas.concat(tables, names=["run", "row"]).reset_index("run").convert_dtypes()
    texts = {RUNS: "{" + ",\n".join(lines) + "}\n"}
    texts[ROWS] = rows.to_csv(index=False, lineterminator="\n")
    for name, text in texts.items():
        with replacing(folder / name) as unfinished:
            unfinished.write_bytes(gzip.compress(text.encode(), mtime=0))


def read_archive(folder: Path) -> dict[str, Recorded]:
    """Read the runs of an archive by their names.

    Raises:
        ValueError: If the files are not those of an archive.
    """
    try:
        entries = json.loads(gzip.decompress((folder / RUNS).read_bytes()))
        configs = {name: entry.pop("config") for name, entry in entries.items()}
        tables = dict(_tables(folder / ROWS))
    except Exception as error:  # the files may hold anything
        raise ValueError(f"{folder.name} is no archive ({error})") from error
    return {
        name: Recorded(configs[name], tables.get(name, {}), notes)
        for name, notes in entries.items()
    }


def _tables(path: Path) -> Iterator[tuple[str, dict[str, list[float]]]]:
    """Tables by run, each with the columns in which it has a number."""
    types: defaultdict[str, type] = defaultdict(lambda: float, run=str)
    rows = import_extra("pandas", "report").read_csv(path, dtype=types)
    for name, table in rows.groupby("run", sort=False):
        own = table.drop(columns="run")
        # before its first episode has ended, a run has no number of these
        always = own.columns.isin(["episode_return", "episode_cost"])
        yield name, own.loc[:, always | own.notna().any()].to_dict("list")


def without_places(notes: Mapping[str, Any]) -> dict[str, Any]:
    """Notes without the folders of this machine, except in the words of command lines."""
    kept = dict(notes)
    start = kept.pop("cwd", None)
    if start and "config_dirs" in kept:
        # as a person would type them where the run was started
        kept["config_dirs"] = [os.path.relpath(path, start) for path in kept["config_dirs"]]
    if "evaluations" in kept:
        kept["evaluations"] = [
            {k: Path(v).name if k == "checkpoint_file" else v for k, v in e.items() if k != "run"}
            for e in kept["evaluations"]
        ]
    return kept


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
