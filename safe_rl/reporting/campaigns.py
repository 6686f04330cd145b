"""Campaigns: which runs their ``plan.yaml`` names, and which of these are done.

A plan is a list of sweeps, each a mapping of keys to one value or a list of values, of which all
combinations are to be run::

    - {env: [PointGoal1, CarGoal1], algo: [ppo, cpo], seed: [0, 10, 20], frames: 1_000_000}
    - {env: PointGoal1, algo: cpo, seed: [0, 10, 20], frames: 1_000_000, cost_limits: {cost: 10}}
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from safe_rl.files import read_yaml
from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import Table, as_override, clean
from safe_rl.runs.folder import paths_below
from safe_rl.runs.identity import flatten, role_of

__all__ = ["PLAN", "campaign_tables", "read_plan"]

PLAN = "plan.yaml"
"""Name of the file, in a campaign's folder."""
_NEEDED = ("env", "algo", "seed", "frames")


class Planned(NamedTuple):
    """Runs that differ in the seed alone.

    Attributes:
        chosen: Key -> value, as on the command line.
        seeds: Of the runs.
    """

    chosen: Mapping[str, Any]
    seeds: tuple[int, ...]


def read_plan(path: Path) -> list[Planned]:
    """Read which runs a campaign is to have.

    Raises:
        ValueError: If the file is no plan; the message says what one is.
        OSError: If it cannot be read.

    Examples:
        >>> path = getfixture("tmp_path") / "plan.yaml"
        >>> _ = path.write_text("- {env: Goal, algo: [ppo, cpo], seed: [0, 1], frames: 1_000}")
        >>> for cell in read_plan(path):
        ...     print(cell.chosen, cell.seeds)
        {'env': 'Goal', 'algo': 'ppo', 'frames': 1000} (0, 1)
        {'env': 'Goal', 'algo': 'cpo', 'frames': 1000} (0, 1)
    """
    sweeps = read_yaml(path)
    if not isinstance(sweeps, list) or not all(isinstance(sweep, dict) for sweep in sweeps):
        raise ValueError(f"{path.name} is no plan: it takes a list of mappings, a sweep each")
    return [cell for sweep in sweeps for cell in _cells(sweep, path.name)]


def _cells(sweep: Mapping[str, Any], name: str) -> Iterator[Planned]:
    missing = [key for key in _NEEDED if key not in sweep]
    if missing:
        raise ValueError(f"{name}: a sweep says {', '.join(_NEEDED)}, and here is no {missing[0]}")
    values = {key: value if isinstance(value, list) else [value] for key, value in sweep.items()}
    for key in ("seed", "frames"):
        if not all(isinstance(n, int) and n >= 0 for n in values[key]):
            raise ValueError(f"{name}: {key} takes whole numbers")
    seeds = tuple(values.pop("seed"))
    for combination in product(*values.values()):
        yield Planned(dict(zip(values, combination, strict=True)), seeds)


def campaign_tables(
    root: Path, runs: Sequence[Run]
) -> tuple[dict[str, list[Table]], dict[Path, str]]:
    """Name of a campaign below a folder -> its tables, and plan -> why it was left out.

    The second table, of the commands of what is missing, is there if anything is.
    """
    plans = {path: path.parent.resolve().name for path in paths_below(root, PLAN)}
    names = list(plans.values())
    tables, skipped = {}, {}
    for path, name in plans.items():
        if names.count(name) > 1 and path.parent != root:  # then by the way there
            name = path.parent.relative_to(root).as_posix()
        try:
            if not path.resolve().is_relative_to(root.resolve()):
                raise ValueError(f"{path.name} is a link to outside of the folder")
            own = [run for run in runs if run.directory.is_relative_to(path.parent)]
            name = clean(name)
            tables[name] = _tables(name, read_plan(path), own)
        except (ValueError, OSError) as error:
            skipped[path] = clean(error)
    return tables, skipped


def _tables(name: str, cells: Sequence[Planned], runs: Sequence[Run]) -> list[Table]:
    records = [_record(name, cell, runs) for cell in cells]
    done, begun = (sum(record[key] for record in records) for key in ("num_done", "num_begun"))
    note = f"{done} of {sum(len(cell.seeds) for cell in cells)} runs are done"
    note += f", {begun} have begun." if begun else "."
    columns = {"environment": "{env}", "algorithm": "{algo}", "steps": "{frames:,}"}
    columns |= {"with": "{further}"} if any(record["further"] for record in records) else {}
    columns |= {state: f"{{{state}}}" for state in ("done", "begun", "missing")}
    shown = [Table(f"campaign_{name}", name, columns, records, note)]
    commands = _commands(cells, [record["seeds_missing"] for record in records])
    if commands:
        columns = {"runs": "{runs:d}", "command": "{command}"}
        shown.append(Table(f"campaign_{name}_missing", f"{name}: missing", columns, commands))
    return shown


def _record(name: str, cell: Planned, runs: Sequence[Run]) -> dict[str, Any]:
    found = [run for run in runs if run.seed in cell.seeds and _is_of(run, cell.chosen)]
    # of one seed the run with most steps
    shares = {
        run.seed: run.steps / max(1, cell.chosen["frames"])
        for run in sorted(found, key=lambda run: run.steps)
    }
    done = [seed for seed, share in sorted(shares.items()) if share >= 1]
    begun = {seed: share for seed, share in sorted(shares.items()) if share < 1}
    missing = tuple(seed for seed in cell.seeds if seed not in shares)
    further = {key: value for key, value in cell.chosen.items() if key not in _NEEDED}
    return {
        "campaign": name,
        **{key: clean(cell.chosen[key], 80) for key in ("env", "algo")},
        "frames": cell.chosen["frames"],
        "further": clean(" ".join(_words(further))) or None,
        **{"num_done": len(done), "num_begun": len(begun), "num_missing": len(missing)},
        "seeds_missing": missing,
        "done": ", ".join(map(str, done)) or "—",
        "begun": ", ".join(f"{seed} ({share:.0%})" for seed, share in begun.items()) or "—",
        "missing": ", ".join(map(str, missing)) or "—",
    }


def _is_of(run: Run, chosen: Mapping[str, Any]) -> bool:
    """Whether a run is what was planned, seeds aside."""
    settings = flatten(run.config)
    settings |= {"env": run.config["env"].get("name"), "algo": run.algorithm}
    # what else a command line has chosen makes it another experiment
    words = (override.lstrip("+~").partition("=") for override in run.overrides or ())
    said = {key: value.strip("'") for key, _, value in words}  # Python's have quotes
    others = [key for key in said if role_of(key).names_experiment and key not in chosen]
    limits = chosen.get("cost_limits")
    # a limit that the plan does not name makes it another one, too
    others += set(run.limits) - set(limits) if isinstance(limits, Mapping) else []
    # what a group was chosen by, as in risk=cvar, only the command line says
    return not others and all(
        settings.get(key) == value or (key not in settings and said.get(key) == value)
        for key, value in flatten(chosen).items()
    )


def _commands(cells: Sequence[Planned], missing: Sequence[tuple[int, ...]]) -> list[dict[str, Any]]:
    """A sweep for all algorithms that lack the same seeds of what is alike otherwise."""
    groups: dict[tuple[tuple[str, ...], tuple[int, ...]], list[str]] = {}
    for cell, seeds in zip(cells, missing, strict=True):
        if seeds:
            alike = {key: value for key, value in cell.chosen.items() if key != "algo"}
            own = groups.setdefault((tuple(_words(alike)), seeds), [])
            own.append(clean(cell.chosen["algo"], 80))
    records = []
    for (others, seeds), algorithms in groups.items():
        number = len(algorithms) * len(seeds)
        words = [f"algo={','.join(algorithms)}", *others, f"seed={','.join(map(str, seeds))}"]
        command = shlex.join(["python", "train.py", *(["-m"] if number > 1 else []), *words])
        records.append({"runs": number, "command": clean(command, 1000)})
    return records


def _words(chosen: Mapping[str, Any]) -> list[str]:
    return [f"{key}={as_override(value)}" for key, value in chosen.items()]
