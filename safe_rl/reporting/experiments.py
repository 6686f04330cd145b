"""Experiments, which are groups of runs that differ only in the seed, and their names."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from safe_rl.files import CONF
from safe_rl.reporting.archive import ReportedRun
from safe_rl.reporting.tables import clean, short_number
from safe_rl.runs.identity import Role, experiment_of, flatten, role_of
from safe_rl.scores.benchmark import ALGORITHMS, COST_LIMIT, REFERENCE, Suite

PACKAGED = frozenset(file.stem for file in (CONF / "algo").glob("*.yaml"))
"""Names of the package's algorithms."""

Settings = Mapping[str, Hashable]

# settings that names contain wherever they differ, even if no command line sets them
_ALWAYS_NAMED = ("preset", "init_from", "frames", "cost_limits", "risk", "source")


@dataclass(frozen=True)
class Experiment:
    """One algorithm with one set of settings on one environment.

    Attributes:
        environment: Name of the environment, with the keys that were changed.
        title: Name of the algorithm, without settings.
        settings: Settings that distinguish it from other experiments with this algorithm.
        benchmark: Name of the environment in the suite if no key was changed, else None.
        runs: One per seed.
    """

    environment: str
    title: str
    settings: Settings
    benchmark: str | None
    runs: tuple[ReportedRun, ...]

    def name_without(self, *groups: str) -> str:
        """Name of the algorithm, with its settings except those of some groups."""
        kept = {k: v for k, v in self.settings.items() if k.partition(".")[0] not in groups}
        return self.title + _in_brackets(kept)

    @property
    def algorithm(self) -> str:
        """Name of the algorithm, with its settings."""
        return self.name_without()

    @property
    def label(self) -> str:
        """The name in pictures with one number of steps: without ``frames``."""
        return self.name_without("frames")

    @property
    def family(self) -> str:
        """The label without limits: equal for one algorithm under several limits."""
        return self.name_without("frames", "cost_limits")

    @property
    def base(self) -> str:
        """Name of the file in ``conf/algo``."""
        return self.runs[0].algorithm

    @property
    def limits(self) -> dict[str, float]:
        """Cost key -> d, undiscounted cost per episode."""
        return self.runs[0].cost_limits

    @property
    def limits_of_other_measures(self) -> list[str]:
        """Cost keys whose limit is on another measure than the mean cost of an episode."""
        return [k for k in self.limits if any(run.limits_another_measure(k) for run in self.runs)]

    @property
    def is_plain(self) -> bool:
        """Whether no transform changes its environment, and no run began with trained networks."""
        settings = [run.settings for run in self.runs]
        return not any(s.get("transforms") or s.get("init_from") is not None for s in settings)

    @property
    def is_published_problem(self) -> bool:
        """Whether it is plain, and its only limit is that of the published results."""
        has_limit = self.limits == {"cost": COST_LIMIT} and not self.limits_of_other_measures
        return has_limit and self.is_plain

    @property
    def is_of_paper(self) -> bool:
        """Whether it has finished runs of one of the paper's algorithms on a published problem."""
        is_known = self.base in ALGORITHMS and self.benchmark in REFERENCE
        return is_known and self.is_published_problem and bool(self.finished)

    @property
    def finished(self) -> tuple[ReportedRun, ...]:
        """Its finished runs."""
        return tuple(run for run in self.runs if run.is_finished)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Environment steps of its finished runs, ascending, without repetitions."""
        return tuple(sorted({run.length for run in self.finished}))

    @property
    def planned_steps(self) -> int:
        """Environment steps after which its runs end."""
        return int(self.runs[0].settings["frames"]) or max(run.steps for run in self.runs)


def cost_keys_of(experiments: Sequence[Experiment]) -> list[str]:
    """The aggregate cost if there is one, and every cost key that an experiment limits."""
    keys = ["cost"] if any("cost_rate" in run.table for e in experiments for run in e.runs) else []
    return list(dict.fromkeys([*keys, *(key for e in experiments for key in e.limits)]))


def group_runs(
    runs: Sequence[ReportedRun], suite: Suite, labels: Mapping[str, str] = {}
) -> tuple[list[Experiment], dict[Path, str]]:
    """Group runs into experiments, in the order of the benchmark and of the paper's tables.

    ``labels``: name of an algorithm in ``conf/algo`` -> its name in tables and pictures. The second
    result is folder -> the reason why a run is left out.
    """
    environments = _environment_names(runs, suite)
    titles = _titles({run.algorithm for run in runs}, labels)
    settings = _settings_of_names(runs, environments)
    cells: dict[tuple[str, str], dict[int, Experiment]] = defaultdict(dict)
    skipped: dict[Path, str] = {}
    # of several runs with one seed, the longest is kept; among equal ones the last by name
    for run in sorted(runs, key=lambda run: (run.steps, run.directory)):
        environment = environments[run.directory]
        title, benchmark = titles[run.algorithm], suite.name_of(run.settings["env"])
        experiment = Experiment(environment, title, settings[run.directory], benchmark, (run,))
        cell = cells[environment, experiment.algorithm]
        if run.seed in cell:
            repeated = cell[run.seed].runs[0].directory
            skipped[repeated] = f"{run.directory} is the same run with the same seed"
        cell[run.seed] = experiment
    ordered = [[cell[seed] for seed in sorted(cell)] for cell in cells.values()]
    experiments = [replace(seeds[0], runs=tuple(e.runs[0] for e in seeds)) for seeds in ordered]
    return sorted(experiments, key=_order), skipped


def _titles(algorithms: Iterable[str], labels: Mapping[str, str]) -> dict[str, str]:
    """Name in ``conf/algo`` -> name in tables; with the first in brackets where others share it."""
    titles = {name: clean(labels.get(name) or title_of(name), 80) for name in algorithms}
    times = Counter(titles.values())
    return {n: f"{t} ({clean(n, 80)})" if times[t] > 1 else t for n, t in titles.items()}


def _order(experiment: Experiment) -> tuple[Hashable, ...]:
    """Sort key: benchmark environments first, algorithms as in the paper, then by name."""
    places = {name: place for place, name in enumerate([*REFERENCE, *ALGORITHMS])}
    environment = places.get(experiment.benchmark or "", 99), experiment.environment
    return *environment, places.get(experiment.base, 99), experiment.algorithm


def _environment_names(runs: Sequence[ReportedRun], suite: Suite) -> dict[Path, str]:
    """Folder -> name of the environment, with the keys that differ from the suite's.

    Names of other environments have the keys in which environments of that name differ.
    """
    alike: dict[str, list[Settings]] = defaultdict(list)
    for run in runs:
        alike[run.environment].append(flatten(run.settings["env"]))
    titles = {}
    for run in runs:
        node = run.settings["env"]
        name = run.environment
        changes = suite.changes(node)
        if changes is None:
            settings, keys = flatten(node), distinguishing_keys([alike[name]])
            changes = {key: settings[key] for key in keys if key in settings}
        titles[run.directory] = clean(name, 80) + _in_brackets(flatten(changes))
    return titles


def _settings_of_names(
    runs: Sequence[ReportedRun], environments: Mapping[Path, str]
) -> dict[Path, Settings]:
    """Folder -> the settings in the name of its run.

    These are settings that differ between runs of the algorithm, and that a user has set. If they
    do not distinguish all experiments on an environment, such as runs from two versions of a
    default, all settings that differ are used there.
    """
    named: dict[Path, Settings] = {}
    by_algorithm: dict[str, dict[str, list[ReportedRun]]] = defaultdict(lambda: defaultdict(list))
    for run in runs:
        by_algorithm[run.algorithm][environments[run.directory]].append(run)
    for cells in by_algorithm.values():
        settings = {run.directory: _settings(run) for cell in cells.values() for run in cell}
        # an experiment may train longer on one environment than on another
        anywhere = [{**of_run, "frames": None} for of_run in settings.values()]
        by_cell = [[settings[run.directory] for run in cell] for cell in cells.values()]
        keys = distinguishing_keys([*by_cell, anywhere])
        for cell in cells.values():
            alike: dict[tuple[tuple[str, Hashable], ...], list[ReportedRun]] = defaultdict(list)
            for run in cell:
                of_run = settings[run.directory]
                known = tuple((key, of_run[key]) for key in keys if of_run.get(key) is not None)
                alike[known].append(run)
            names = {
                known: tuple(p for p in known if any(_is_given(p[0], run) for run in members))
                for known, members in alike.items()
            }
            for known, members in alike.items():
                name = names[known] if len(set(names.values())) == len(names) else known
                named |= {run.directory: dict(name) for run in members}
    return named


def _is_given(key: str, run: ReportedRun) -> bool:
    """Whether a user has set a key, or chosen the group that it belongs to.

    In a run with YAML files of the user's, any key may have been set there.
    """
    if run.notes.get("config_dirs") or key in run.notes.get("changed", ()):
        return True
    keys = {override.lstrip("+~").partition("=")[0] for override in run.overrides or ()}
    return key.partition(".")[0] in _ALWAYS_NAMED or any(
        key == given or key.startswith(f"{given.partition('@')[0]}.") for given in keys
    )


def title_of(algorithm: str) -> str:
    """The usual spelling of the name of a package's algorithm; other names do not change.

    Examples:
        >>> title_of("c_trpo"), title_of("sac_lagrangian"), title_of("my_idea")
        ('C-TRPO', 'SAC-Lagrangian', 'my_idea')
    """
    if algorithm not in PACKAGED:
        return algorithm
    written = (w.capitalize() if len(w) > 6 else w.upper() for w in algorithm.split("_"))
    return ALGORITHMS.get(algorithm) or "-".join(written)


def _settings(run: ReportedRun) -> dict[str, Hashable]:
    """The settings that may distinguish a run's algorithm from others of the same name."""
    settings = experiment_of(run.settings)
    # some keys only repeat the length of the run
    lengths = {key for key in settings if role_of(key) is Role.LENGTH} - {"frames"}
    repeated = {key for key in lengths if settings[key] == run.settings["frames"]}
    kept = {k: v for k, v in settings.items() if k not in repeated and not k.startswith("env.")}
    return {**kept, "source": run.source or None}


def distinguishing_keys(cells: Sequence[Sequence[Settings]]) -> list[str]:
    """Keys that differ within a cell, except those whose values follow from other keys.

    A value may follow from ``preset``, or from the ``_target_`` of a group above its key.

    Examples:
        >>> small, large = {"preset": "a", "model.width": 1}, {"preset": "b", "model.width": 2}
        >>> distinguishing_keys([[small, large, small]])
        ['preset']
    """
    keys = {key for cell in cells for settings in cell for key in settings}
    order = sorted(keys, key=lambda key: (key != "preset", key.count("."), key))
    return [key for key in order if any(not _follows(key, cell) for cell in cells)]


def _follows(key: str, cell: Sequence[Settings]) -> bool:
    """Whether a key's value follows from ``preset`` and the ``_target_`` of groups above it."""
    names = key.split(".")
    groups = [".".join([*names[:depth], "_target_"]) for depth in range(1, len(names))]
    above = [other for other in ("preset", *groups) if other != key]
    pairs = {(tuple(s.get(other) for other in above), s.get(key)) for s in cell}
    return len(pairs) == len({values for values, _ in pairs})


def _in_brackets(settings: Settings) -> str:
    """Settings in brackets, ``" (1M steps, cost ≤ 10)"``; "" without settings."""
    texts = []
    for key, value in settings.items():
        if key.endswith("._target_"):
            key, value = key.removesuffix("._target_"), str(value).rpartition(".")[2]
        shown = clean(_as_override(value))
        if key == "frames" and isinstance(value, int | float):
            texts.append(f"{short_number(value)} steps")
        elif key == "source":
            texts.append(shown)
        elif key.startswith("cost_limits."):
            texts.append(f"{clean(key.removeprefix('cost_limits.'))} ≤ {shown}")
        else:
            texts.append(f"{clean(key)}={shown}")
    return f" ({', '.join(texts)})" if texts else ""


def _as_override(value: Hashable) -> str:
    """A value as on a command line: ``[10,a,null]``."""
    if isinstance(value, tuple):
        return f"[{','.join(map(_as_override, value))}]"
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    if isinstance(value, float):
        return f"{value:g}" if float(f"{value:g}") == value else f"{value}"
    return f"{value:_}" if isinstance(value, int) else str(value)
