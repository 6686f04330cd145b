"""Names of environments and algorithms: what was chosen, and what else differs between runs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path

from safe_rl.reporting.origins import Origin, source_of_seeds
from safe_rl.reporting.recorded import Run, clean
from safe_rl.runs.identity import experiment_of, flatten
from safe_rl.scores.benchmark import Suite
from safe_rl.scores.published import ALGORITHMS

__all__ = ["algorithm_names", "distinguishing_keys", "environment_names"]

Settings = dict[str, Hashable]

# keys in a name, and letters of a name: beyond, a name is cut off and numbered
_MOST_KEYS, _LONGEST_NAME, _LONGEST_VALUE = 12, 240, 60


def environment_names(runs: Sequence[Run], suite: Suite) -> dict[Path, str]:
    """Folder -> name of the environment, with the keys that differ from the suite's.

    Of an environment that is not in the suite, the first run's settings are the measure.
    """
    firsts: dict[str, Settings] = {}
    titles, keys = {}, {}
    for run in runs:
        node = run.config["env"]
        name = str(node.get("name", "environment"))
        settings = flatten(node)
        changes = suite.changes(node)
        if changes is None:
            first = firsts.setdefault(name, settings)
            shown = {k: v for k, v in settings.items() if k not in first or v != first[k]}
        else:
            shown = settings = flatten(changes)
        keys[run.directory] = settings
        titles[run.directory] = clean(name, 80) + _in_brackets(shown)
    return _unique(titles, keys)


def algorithm_names(
    runs: Sequence[Run],
    environments: Mapping[Path, str],
    origins: Mapping[Path, Origin],
    root: Path,
) -> dict[Path, str]:
    """Folder -> name of the algorithm, with the settings that tell it from its namesakes."""
    titles, settings = {}, {}
    for run in runs:
        settings[run.directory] = _learning_settings(run, origins.get(run.directory), root)
    for algorithm in {run.algorithm for run in runs}:
        members = [run.directory for run in runs if run.algorithm == algorithm]
        cells: dict[str, list[Settings]] = defaultdict(list)
        for member in members:
            cells[environments[member]].append(settings[member])
        # an experiment may train longer on one environment than on another
        anywhere = [{**settings[member], "frames": None} for member in members]
        keys = distinguishing_keys([*cells.values(), anywhere])
        for member in members:
            own = {key: settings[member].get(key) for key in keys}
            known = {key: value for key, value in own.items() if value is not None}
            settings[member] = {"algo": algorithm, **own}
            titles[member] = clean(ALGORITHMS.get(algorithm, algorithm), 80) + _in_brackets(known)
    return _unique(titles, settings)


def _learning_settings(run: Run, origin: Origin | None, root: Path) -> Settings:
    named = experiment_of(run.config).items()
    settings = {key: value for key, value in named if key.partition(".")[0] != "env"}
    if run.init_from is not None:
        settings["init_from"] = source_of_seeds(run, origin, root)
    # what is as the preset has it for the robot, and so as on another robot, tells nothing apart
    robots = (Path(str(run.config["env"].get("robot_base"))).stem, "point")

    def of_robot(key: str) -> Hashable:
        places = (f"paper.{key}.{robot}" for robot in robots)
        return next((settings[place] for place in places if place in settings), None)

    return {key: value for key, value in settings.items() if value != of_robot(key)}


def distinguishing_keys(cells: Iterable[Sequence[Settings]]) -> list[str]:
    """Keys that differ within a cell, but for those that follow from another one.

    What follows from ``preset``, or from the ``_target_`` of the group that a key belongs to, is
    not named: it is told by these.

    Args:
        cells: Groups of settings that have to be told apart within the group, not across groups.

    Examples:
        >>> small, large = {"preset": "a", "model.width": 1}, {"preset": "b", "model.width": 2}
        >>> distinguishing_keys([[small, large, small]])
        ['preset']
    """
    cells = [list(cell) for cell in cells]
    keys = {key for cell in cells for settings in cell for key in settings}
    order = sorted(keys, key=lambda key: (key != "preset", key.count("."), key))
    return [key for key in order if any(not _follows(key, cell) for cell in cells)]


def _follows(key: str, cell: Sequence[Settings]) -> bool:
    """Whether a key's value is settled by those of the keys that stand for it."""
    names = key.split(".")
    groups = [".".join([*names[:depth], "_target_"]) for depth in range(1, len(names))]
    above = [other for other in ("preset", *groups) if other != key]
    values: dict[tuple[Hashable, ...], Hashable] = {}
    return all(
        values.setdefault(tuple(s.get(other) for other in above), s.get(key)) == s.get(key)
        for s in cell
    )


def _unique(titles: Mapping[Path, str], settings: Mapping[Path, Settings]) -> dict[Path, str]:
    """Titles of bounded length that are alike only where settings are."""
    taken: dict[str, list[Settings]] = defaultdict(list)
    names = {}
    for place, title in titles.items():
        short = clean(title, _LONGEST_NAME)
        own = taken[short]
        if settings[place] not in own:
            own.append(settings[place])
        number = own.index(settings[place]) + 1
        names[place] = short if number == 1 else f"{short} #{number}"
    return names


def _in_brackets(settings: Mapping[str, Hashable]) -> str:
    """Settings as on the command line, ``" (frames=1000)"``, or nothing."""
    texts = []
    for key, value in settings.items():
        if key.endswith("._target_"):
            key, value = key.removesuffix("._target_"), str(value).rpartition(".")[2]
        relation = " ≤ " if key.startswith("cost_limits.") else "="
        shown = clean(_text(value), _LONGEST_VALUE)
        texts.append(f"{clean(key.removeprefix('cost_limits.'))}{relation}{shown}")
    if len(texts) > _MOST_KEYS:
        texts[_MOST_KEYS:] = ["…"]
    return f" ({', '.join(texts)})" if texts else ""


def _text(value: Hashable) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, tuple):
        return f"[{','.join(map(_text, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
