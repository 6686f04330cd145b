"""Names of environments and algorithms: what was chosen, and what else differs between runs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from safe_rl.reporting.cleaning import clean
from safe_rl.reporting.origins import Origin, source_of_seeds
from safe_rl.reporting.recorded import Run
from safe_rl.runs.identity import Role, experiment_of, flatten, role_of
from safe_rl.scores.benchmark import Suite
from safe_rl.scores.published import ALGORITHMS

__all__ = ["Named", "algorithm_names", "distinguishing_keys", "environment_names", "title_of"]

Settings = dict[str, Hashable]

# keys in a name, and letters of a name: beyond, a name is cut off and numbered
_MOST_KEYS, _LONGEST_NAME, _LONGEST_VALUE = 12, 240, 60
# from how many differing keys on a name has only as many as it takes, and these
_MANY_KEYS = 3
_ALWAYS_NAMED = ("preset", "init_from", "frames", "cost_limits", "risk")
# of those that the paper does not name; where there is none, the file in conf/algo is its name
_TITLES = {
    **{name: name.upper() for name in ("bc", "cal", "crpo", "cup", "focops", "ipo")},
    **{name: name.upper() for name in ("p3o", "pcpo", "rcpo", "sac", "td3", "wcsac")},
    "c_trpo": "C-TRPO",
    **{"sac_lagrangian": "SAC-Lagrangian", "td3_lagrangian": "TD3-Lagrangian"},
}


class Named(NamedTuple):
    """A name, and all settings that differ among namesakes if not all of them are in it."""

    name: str
    settings: str


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
    *,
    but_for: str = "",
) -> dict[Path, Named]:
    """Folder -> name of the algorithm, with the settings that tell it from its namesakes.

    Where many settings differ, as few are in the name as tell all apart.

    Args:
        runs: Runs of any algorithms.
        environments: Folder -> name of the environment.
        origins: Folder -> what the run started from.
        root: Folder of all runs.
        but_for: A group of settings that is to tell nothing apart.
    """
    titles, settings, differing = {}, {}, {}
    for run in runs:
        own = _learning_settings(run, origins.get(run.directory), root)
        kept = {key: value for key, value in own.items() if key.partition(".")[0] != but_for}
        settings[run.directory] = kept
    for algorithm in {run.algorithm for run in runs}:
        members = [run.directory for run in runs if run.algorithm == algorithm]
        cells: dict[str, list[Settings]] = defaultdict(list)
        for member in members:
            cells[environments[member]].append(settings[member])
        # an experiment may train longer on one environment than on another
        anywhere = [{**settings[member], "frames": None} for member in members]
        keys = distinguishing_keys([*cells.values(), anywhere])
        short = _enough(keys, [settings[member] for member in members])
        for member in members:
            own = {key: settings[member].get(key) for key in keys}
            known = {key: value for key, value in own.items() if value is not None}
            named = {key: value for key, value in known.items() if key in short}
            settings[member] = {"algo": algorithm, **own}
            titles[member] = clean(title_of(algorithm), 80) + _in_brackets(named)
            differing[member] = _in_brackets(known)[2:-1] if len(known) > len(named) else ""
    names = _unique(titles, settings)
    return {place: Named(name, differing[place]) for place, name in names.items()}


def _enough(keys: Sequence[str], members: Sequence[Settings]) -> set[str]:
    """As few of the keys as tell all apart that differ in any, where it would be many.

    What a reader looks for in a name stays in it.
    """
    kept = [k for k in keys if k.partition(".")[0] in _ALWAYS_NAMED]

    def groups(names: Sequence[str]) -> int:
        return len({tuple(member.get(name) for name in names) for member in members})

    while len(keys) > _MANY_KEYS and groups(kept) < groups(keys):
        left = [key for key in keys if key not in kept]
        kept.append(max(left, key=lambda key: groups([*kept, key])))
    return set(keys) if len(keys) <= _MANY_KEYS else set(kept)


def title_of(algorithm: str) -> str:
    """How the field writes the name of an algorithm.

    Examples:
        >>> title_of("c_trpo"), title_of("sac_lagrangian"), title_of("mine")
        ('C-TRPO', 'SAC-Lagrangian', 'mine')
    """
    return ALGORITHMS.get(algorithm) or _TITLES.get(algorithm, algorithm)


def _learning_settings(run: Run, origin: Origin | None, root: Path) -> Settings:
    named = experiment_of(run.config).items()
    settings = {key: value for key, value in named if key.partition(".")[0] != "env"}
    # what only says again how long the run is
    settings = {
        key: value
        for key, value in settings.items()
        if key == "frames" or role_of(key) is not Role.LENGTH or value != settings.get("frames")
    }
    if run.init_from is not None:
        settings["init_from"] = source_of_seeds(run, origin, root)
    # what is as the preset has it for the robot, and so as on another robot, tells nothing apart
    robots = (Path(str(run.config["env"].get("robot_base"))).stem, "point")

    def of_robot(key: str) -> Hashable:
        places = (f"paper.{key}.{robot}" for robot in robots)
        return next((settings[place] for place in places if place in settings), None)

    return {key: value for key, value in settings.items() if value != of_robot(key)}


def distinguishing_keys(cells: Iterable[Sequence[Settings]]) -> list[str]:
    """Keys that differ within a cell, except those whose values follow from another key.

    Those that follow from ``preset``, or from the ``_target_`` of the group that a key belongs to,
    are told by these.

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
    if isinstance(value, float):
        return f"{value:g}"
    # as Hydra takes it, too
    return f"{value:_}" if isinstance(value, int) else str(value)
