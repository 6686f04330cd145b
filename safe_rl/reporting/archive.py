"""A campaign in two files: what its runs recorded, and the rows of all their tables.

``runs.json`` has a line per run. Settings that all runs share stand once, under ``shared``; those
of a run are its differences from them, or from the run that it is ``like``. ``rows.csv.gz`` has
the epochs of all runs, with the run in the first column. The notes of a run are read with the types
that tables need.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import os
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from safe_rl.extras import import_extra
from safe_rl.files import read_bounded, read_json, replace_text, replacing
from safe_rl.reporting.tables import clean
from safe_rl.runs.folder import checkpoint_steps

__all__ = [
    *("ROWS", "RUNS", "Recorded", "read_archive", "read_certificate", "read_code"),
    *("read_evaluation", "without_places", "write_archive"),
]

RUNS, ROWS = "runs.json", "rows.csv.gz"
_MOST_BYTES = 300_000_000  # of each file, unpacked; a hundred runs have about ten million
_COMMIT_LETTERS = 10
_MOST_DIFFERENCES = 12  # up to which a run is described as like another one


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
    """Write a campaign's runs; the same runs make the same bytes.

    Args:
        runs: Path below the campaign, such as ``PointGoal1/cpo/seed0`` -> the run.
        folder: The campaign's folder, made if need be.

    Raises:
        ValueError: If a configuration has a key with a dot.

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
    flat = {name: _flatten(run.config) for name, run in runs.items()}
    shared = _shared(list(flat.values()))
    lines = [f'"shared": {json.dumps(shared)}']
    heads: dict[str, Mapping[str, Any]] = {}
    for name, run in runs.items():
        settings = _described(name, flat[name], shared, heads)
        lines.append(f"{json.dumps(name)}: {json.dumps({**settings, **run.notes})}")
    replace_text(folder / RUNS, "{" + ",\n".join(lines) + "}\n")
    tables = {name: pandas.DataFrame(run.table) for name, run in runs.items()}
    rows = pandas.concat(tables, names=["run", "row"]).reset_index("run")
    text = rows.convert_dtypes().to_csv(index=False, lineterminator="\n")
    with replacing(folder / ROWS) as unfinished:
        unfinished.write_bytes(gzip.compress(text.encode(), mtime=0))


def read_archive(folder: Path) -> dict[str, Recorded]:
    """Read a campaign's runs.

    Raises:
        ValueError: If the files are not those of an archive, or larger than any.
        OSError: If they cannot be read.
    """
    try:
        entries = read_json(folder / RUNS, _MOST_BYTES)
        shared = entries.pop("shared")
        configs: dict[str, dict[str, Any]] = {}
        notes: dict[str, dict[str, Any]] = {}
        for name, entry in entries.items():
            own, without = entry.pop("config"), entry.pop("without", [])
            above = configs[entry.pop("like")] if "like" in entry else shared
            configs[name] = {k: v for k, v in {**above, **own}.items() if k not in without}
            notes[name] = entry
        tables = dict(_tables(folder / ROWS))
    except (AttributeError, KeyError, TypeError, zlib.error, EOFError) as error:
        raise ValueError(f"{folder.name} is no archive ({error})") from error
    return {
        name: Recorded(_unflatten(config), tables.get(name, {}), notes[name])
        for name, config in configs.items()
    }


def _tables(path: Path) -> Iterator[tuple[str, dict[str, list[float]]]]:
    """Tables by run, each with the columns in which it has a number."""
    pandas = import_extra("pandas", "report")
    with gzip.open(io.BytesIO(read_bounded(path, _MOST_BYTES))) as file:
        content = file.read(_MOST_BYTES + 1)  # a small file can unpack to any size
    if len(content) > _MOST_BYTES:
        raise ValueError(f"{path.name} unpacks to more than {_MOST_BYTES:,} bytes")
    types: defaultdict[str, type] = defaultdict(lambda: float, run=str)
    rows = pandas.read_csv(io.BytesIO(content), dtype=types)
    for name, table in rows.groupby("run", sort=False):
        own = table.drop(columns="run")
        # before its first episode has ended, a run has no number of these
        always = own.columns.isin(["episode_return", "episode_cost"])
        yield name, own.loc[:, always | own.notna().any()].to_dict("list")


def _described(
    name: str,
    config: Mapping[str, Any],
    shared: Mapping[str, Any],
    heads: dict[str, Mapping[str, Any]],
) -> dict[str, Any]:
    """A configuration as its differences from an earlier run's, or from what all share."""
    found = {other: _differences(config, above) for other, above in heads.items()}
    nearest = min(found, key=lambda other: sum(map(len, found[other])), default=None)
    if nearest is None or sum(map(len, found[nearest])) > _MOST_DIFFERENCES:
        heads[name] = config
        return {"config": _differences(config, shared)[0]}
    own, without = found[nearest]
    return {"like": nearest, "config": own, **({"without": without} if without else {})}


def _differences(
    config: Mapping[str, Any], above: Mapping[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    own = {k: v for k, v in config.items() if k not in above or not _same(above[k], v)}
    return own, [key for key in above if key not in config]


def _shared(configs: list[dict[str, Any]]) -> dict[str, Any]:
    first, *others = configs
    return {
        key: value
        for key, value in first.items()
        if all(key in other and _same(other[key], value) for other in others)
    }


def _same(first: Any, second: Any) -> bool:
    """Whether two values are written alike: 1, 1.0 and true are equal, and are not."""
    return first == second and repr(first) == repr(second)


def _flatten(node: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in node.items():
        if "." in key:
            raise ValueError(f"a run whose configuration has the key '{key}' cannot be archived")
        if isinstance(value, Mapping) and value:
            flat |= _flatten(value, f"{above}{key}.")
        else:
            flat[f"{above}{key}"] = value
    return flat


def _unflatten(flat: Mapping[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for path, value in flat.items():
        *groups, key = path.split(".")
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
        node[key] = value
    return tree


def without_places(notes: Mapping[str, Any]) -> dict[str, Any]:
    """Notes without the folders of this machine, but for what command lines said."""
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


def read_evaluation(content: Any) -> dict[str, Any]:
    """An evaluation with the types that tables need.

    Raises:
        ValueError: If it is none.
    """
    with _in_words("it is no evaluation"):
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


def read_certificate(content: Any) -> dict[str, Any]:
    """A certificate with the types that tables need; its ``checkpoint`` is None if it has none.

    Raises:
        ValueError: If it is none.
    """
    with _in_words("it is no certificate"):
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


def read_code(content: Any) -> str:
    """By which code a run was carried out, and from which step on by which other one.

    Raises:
        ValueError: If it does not say so.
    """
    parts = []
    with _in_words("it says nothing of the code"):
        for entry in content[:9]:
            words = [clean(entry["version"], 20), clean(entry["commit"] or "")[:_COMMIT_LETTERS]]
            words += ["with changes"] if entry["changed"] else []
            words += [f"from {int(entry['steps']):,} steps on"] if entry["steps"] else []
            parts.append(" ".join(filter(None, words)))
    return "; ".join(parts)


@contextmanager
def _in_words(otherwise: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{otherwise} ({type(error).__name__}: {error})") from error


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
