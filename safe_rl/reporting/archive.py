"""An archive of runs in two files: what every run recorded, and the rows of all their tables.

``runs.json.gz`` has a line per run: its configuration and its notes. ``rows.csv.gz`` has the epochs
of all runs, with the run in the first column.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from safe_rl.extras import import_extra
from safe_rl.files import read_bounded, replacing

__all__ = ["ROWS", "RUNS", "Recorded", "read_archive", "without_places", "write_archive"]

RUNS, ROWS = "runs.json.gz", "rows.csv.gz"
_MOST_BYTES = 300_000_000  # of each file, unpacked; a hundred runs have about ten million


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
        ValueError: If the files are not those of an archive, or larger than any.
        OSError: If they cannot be read.
    """
    try:
        entries = json.loads(_unpack(folder / RUNS))
        configs = {name: entry.pop("config") for name, entry in entries.items()}
        tables = dict(_tables(folder / ROWS))
    except (ValueError, LookupError, AttributeError, TypeError, RecursionError) as error:
        raise ValueError(f"{folder.name} is no archive ({error})") from error
    return {
        name: Recorded(configs[name], tables.get(name, {}), notes)
        for name, notes in entries.items()
    }


def _tables(path: Path) -> Iterator[tuple[str, dict[str, list[float]]]]:
    """Tables by run, each with the columns in which it has a number."""
    types: defaultdict[str, type] = defaultdict(lambda: float, run=str)
    rows = import_extra("pandas", "report").read_csv(io.BytesIO(_unpack(path)), dtype=types)
    for name, table in rows.groupby("run", sort=False):
        own = table.drop(columns="run")
        # before its first episode has ended, a run has no number of these
        always = own.columns.isin(["episode_return", "episode_cost"])
        yield name, own.loc[:, always | own.notna().any()].to_dict("list")


def _unpack(path: Path) -> bytes:
    try:
        with gzip.open(io.BytesIO(read_bounded(path, _MOST_BYTES))) as file:
            content = file.read(_MOST_BYTES + 1)  # a small file can unpack to any size
    except (gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise ValueError(f"{path.name} cannot be read ({error})") from error
    if len(content) > _MOST_BYTES:
        raise ValueError(f"{path.name} unpacks to more than {_MOST_BYTES:,} bytes")
    return content


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
