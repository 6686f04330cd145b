"""Runs that differ in nothing but the seed: their names."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from safe_rl.reporting.recorded import Run
from safe_rl.reporting.tables import clean
from safe_rl.runs.identity import Role, experiment_of, flatten, role_of
from safe_rl.scores.benchmark import Suite
from safe_rl.scores.published import ALGORITHMS, COST_LIMIT, REFERENCE, Scores

__all__ = [
    *("Experiment", "cost_keys_of", "distinguishing_keys", "group_runs"),
    "title_of",
]

Settings = dict[str, Hashable]

# longer names are cut off and numbered; above _MANY_KEYS they have as few keys as it takes
_MOST_KEYS, _LONGEST_NAME, _LONGEST_VALUE, _MANY_KEYS = 12, 240, 60, 3
_ALWAYS_NAMED = ("preset", "init_from", "frames", "cost_limits", "risk")
# of those that the paper does not name; where there is none, the file in conf/algo is its name
_TITLES = {
    **{name: name.upper() for name in ("bc", "cal", "crpo", "cup", "focops", "ipo")},
    **{name: name.upper() for name in ("p3o", "pcpo", "rcpo", "sac", "td3", "wcsac")},
    **{"sac_lagrangian": "SAC-Lagrangian", "td3_lagrangian": "TD3-Lagrangian", "c_trpo": "C-TRPO"},
}


@dataclass(frozen=True)
class Experiment:
    """One algorithm on one environment.

    Attributes:
        environment: Name of the environment, with what was changed of it.
        algorithm: Name of the algorithm, with what tells it from others of that name.
        benchmark: Name in the suite if the environment is exactly that one, else None.
        runs: One per seed.
        family: Name of the algorithm where limits are no difference, so that the same algorithm
            under several limits has one; "" is a family of its own.
        settings: All that differs from its namesakes, if that is more than its name says.
    """

    environment: str
    algorithm: str
    benchmark: str | None
    runs: tuple[Run, ...]
    family: str = ""
    settings: str = ""

    @property
    def reference(self) -> Scores | None:
        """Characteristic metrics to normalise by, if the environment has them."""
        return REFERENCE.get(self.benchmark or "")

    @property
    def limits(self) -> dict[str, float]:
        """Cost key -> d, undiscounted cost per episode."""
        return self.runs[0].limits

    @property
    def has_published_limit(self) -> bool:
        """Whether it has the limit, and only that, with which results were published."""
        return self.limits == {"cost": COST_LIMIT} and not self.limits_of_other_measures

    @property
    def limits_of_other_measures(self) -> list[str]:
        """Cost keys whose limit is on something else than the mean cost of an episode."""
        return [k for k in self.limits if any(run.limits_another_measure(k) for run in self.runs)]

    @property
    def is_continued(self) -> bool:
        """Whether a run of it started from another run's networks."""
        return any(run.init_from is not None for run in self.runs)

    @property
    def finished(self) -> tuple[Run, ...]:
        """Runs that have come to their configured end."""
        return tuple(run for run in self.runs if run.is_finished)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Environment steps of its finished runs, ascending, each number once."""
        return tuple(sorted({run.length for run in self.finished}))


def cost_keys_of(experiments: Iterable[Experiment]) -> list[str]:
    """The aggregate cost if there is one, and every cost key that an experiment limits."""
    experiments = list(experiments)
    keys = ["cost"] if any("cost_rate" in run.table for e in experiments for run in e.runs) else []
    return list(dict.fromkeys([*keys, *(key for e in experiments for key in e.limits)]))


def group_runs(runs: Sequence[Run], suite: Suite) -> tuple[list[Experiment], dict[Path, str]]:
    """Group runs into experiments, in the order of the benchmark and of the paper's tables.

    Args:
        runs: Runs of any environments and algorithms.
        suite: The benchmark.

    Returns:
        Experiments, and folder -> why a run was left out.
    """
    environments = _environment_names(runs, suite)
    settings = {r.directory: _settings(r) for r in runs}
    algorithms, differing = _algorithm_names(runs, environments, settings)
    without_limits = {
        place: {key: value for key, value in own.items() if not key.startswith("cost_limits.")}
        for place, own in settings.items()
    }
    families, _ = _algorithm_names(runs, environments, without_limits)
    cells: dict[tuple[str, str], list[Run]] = defaultdict(list)
    for run in runs:
        cells[environments[run.directory], algorithms[run.directory]].append(run)
    skipped: dict[Path, str] = {}
    experiments = []
    for names, members in cells.items():
        kept = _without_repetitions(members, skipped)
        first, benchmark = kept[0].directory, suite.name_of(kept[0].config["env"])
        own = (*names, benchmark, tuple(kept), families[first], differing[first])
        experiments.append(Experiment(*own))
    return sorted(experiments, key=_order), skipped


def _order(experiment: Experiment) -> tuple[Hashable, ...]:
    """Benchmark environments first, algorithms as in the paper, variants behind each other."""
    benchmarks = {name: place for place, name in enumerate(REFERENCE)}
    algorithms = {name: place for place, name in enumerate(ALGORITHMS)}
    places = benchmarks.get(experiment.benchmark or "", 99), experiment.environment
    return *places, algorithms.get(experiment.runs[0].algorithm, 99), experiment.algorithm


def _without_repetitions(runs: Sequence[Run], skipped: dict[Path, str]) -> list[Run]:
    """Runs by seed, each once: the one that has come further, then the last by folder name."""
    kept: dict[int, Run] = {}
    for run in sorted(runs, key=lambda run: (run.steps, run.directory)):
        if run.seed in kept:
            skipped[kept[run.seed].directory] = (
                f"{run.directory} is the same run with the same seed"
            )
        kept[run.seed] = run
    return [kept[seed] for seed in sorted(kept)]


def _environment_names(runs: Sequence[Run], suite: Suite) -> dict[Path, str]:
    """Folder -> name of the environment, with the keys that differ from the suite's, or first's."""
    firsts: dict[str, Settings] = {}
    titles, keys = {}, {}
    for run in runs:
        node = run.config["env"]
        name = str(node.get("name", "environment"))
        shown = settings = flatten(node)
        changes = suite.changes(node)
        if changes is None:
            first = firsts.setdefault(name, settings)
            shown = {k: v for k, v in settings.items() if k not in first or v != first[k]}
        else:
            shown = settings = flatten(changes)
        keys[run.directory] = settings
        titles[run.directory] = clean(name, 80) + _in_brackets(shown)
    return _unique(titles, keys)


def _algorithm_names(
    runs: Sequence[Run], environments: Mapping[Path, str], settings: Mapping[Path, Settings]
) -> tuple[dict[Path, str], dict[Path, str]]:
    """Folder -> name of the algorithm, with what tells it from its namesakes; and all of that."""
    titles, identities, differing = {}, {}, {}
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
            identities[member] = {"algo": algorithm, **own}
            titles[member] = clean(title_of(algorithm), 80) + _in_brackets(named)
            differing[member] = _in_brackets(known)[2:-1] if len(known) > len(named) else ""
    ordered = {run.directory: titles[run.directory] for run in runs}
    return _unique(ordered, identities), differing


def _enough(keys: Sequence[str], members: Sequence[Settings]) -> set[str]:
    """As few of the keys as tell all apart that differ in any, where it would be many."""
    if len(keys) <= _MANY_KEYS:
        return set(keys)
    kept = [k for k in keys if k.partition(".")[0] in _ALWAYS_NAMED]

    def groups(names: Sequence[str]) -> int:
        return len({tuple(member.get(name) for name in names) for member in members})

    while groups(kept) < groups(keys):
        left = [key for key in keys if key not in kept]
        kept.append(max(left, key=lambda key: groups([*kept, key])))
    return set(kept)


def title_of(algorithm: str) -> str:
    """How the field writes the name of an algorithm.

    Examples:
        >>> title_of("c_trpo"), title_of("sac_lagrangian"), title_of("mine")
        ('C-TRPO', 'SAC-Lagrangian', 'mine')
    """
    return ALGORITHMS.get(algorithm) or _TITLES.get(algorithm, algorithm)


def _settings(run: Run) -> Settings:
    """What tells a run's algorithm from others of the same name."""
    named = experiment_of(run.config).items()
    settings = {key: value for key, value in named if key.partition(".")[0] != "env"}
    for key in [key for key in settings if role_of(key) is Role.LENGTH and key != "frames"]:
        if settings[key] == settings.get("frames"):
            del settings[key]  # it only says again how long the run is
    # what is as the preset has it for the robot, and so as on another robot, tells nothing apart
    robots = (Path(str(run.config["env"].get("robot_base"))).stem, "point")

    def of_robot(key: str) -> Hashable:
        found = (settings.get(f"paper.{key}.{robot}") for robot in robots)
        return next((value for value in found if value is not None), None)

    return {key: value for key, value in settings.items() if value != of_robot(key)}


def distinguishing_keys(cells: Sequence[Sequence[Settings]]) -> list[str]:
    """Keys that differ within a cell, except those whose values follow from another key.

    Those that follow from ``preset``, or from the ``_target_`` of the group that a key belongs to,
    are told by these. Settings are told apart within a cell, not across cells.

    Examples:
        >>> small, large = {"preset": "a", "model.width": 1}, {"preset": "b", "model.width": 2}
        >>> distinguishing_keys([[small, large, small]])
        ['preset']
    """
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
    form = {float: "g", int: "_"}.get(type(value), "")
    return f"{value:{form}}" if form else str(value)
