"""Tables of results for the pages, made from the archived runs in ``results/``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import yaml

from safe_rl.cli.report import suite
from safe_rl.envs import SUITE
from safe_rl.reporting.archive import read_archive
from safe_rl.reporting.experiments import group_runs
from safe_rl.reporting.scoring import paper_table
from safe_rl.scores.benchmark import ALGORITHMS
from safe_rl.scores.bounds import rounded_up

ROOT = Path(__file__).resolve().parents[2]
LIMIT, SPAN, MILLION = 25.0, 20_000, 1_000_000
# column -> its heading
HEADS = {
    "environment": "environment", "algorithm": "`algo=`", "name": "setting", "steps": "steps",
    "seeds": "seeds", "cost": "episode cost", "return": "return", "since": "cost from 1M",
    "above": "above 25", "rate": "$\\rho_c$", "certified": "certified, at returns of",
    "new": "new episodes", "bound": "certified", "omnisafe": "OmniSafe, 10M steps",
    "paper": "Ray et al. (2019), 10M steps", "tail": "CVaR",
}  # fmt: skip
# "PPOLag" in Table 2 of OmniSafe's benchmarks/on-policy/README.md, commit 15603dd: cost / return
OMNISAFE = {
    "SafeAntVelocity": "12.1 ± 6.6 / 3262 ± 80",
    "SafeHalfCheetahVelocity": "3.4 ± 4.8 / 2946 ± 306",
    "SafeHopperVelocity": "14.0 ± 19.3 / 962 ± 753",
    "SafeHumanoidVelocity": "5.9 ± 9.5 / 6624 ± 26",
    "SafeSwimmerVelocity": "28.0 ± 4.1 / 65 ± 18",
    "SafeWalker2dVelocity": "13.5 ± 14.6 / 2982 ± 682",
}
_THREE_MILLION = ("reference", "held_out", "eighteen")  # campaigns with the defaults
_CELL = ("environment", "algorithm")  # of a table: the runs that differ in seeds only
Rows = list[dict[str, Any]]


@cache
def runs(campaign: str) -> pandas.DataFrame:
    """Runs of a campaign: environment, algorithm, name of the setting or "", seed, and the run."""
    found, folder = [], ROOT / "results" / campaign
    for path, run in (read_archive(folder) if folder.is_dir() else {}).items():
        env, *names, seed = path.split("/")
        algo = run.config["algo"]["name"]
        name = "/".join(name for name in names if name != algo)
        found.append((env, algo, name, int(seed.removeprefix("seed")), run))
    order = {env: place for place, env in enumerate(SUITE)}
    found.sort(key=lambda entry: (order.get(entry[0], 0), *entry[:4]))
    return pandas.DataFrame(found, columns=["environment", "algorithm", "name", "seed", "run"])


def figures(run: Any, last: float, start: float = 0) -> dict[str, float]:
    """Figures of a run: return and cost of an episode over its last steps, costs after `start`.

    ``since`` is the cost from `start` on, ``above`` the share of spans of 20,000 steps from there
    on whose mean cost is above the limit, ``rate`` the cost of a step of the whole run.
    """
    epochs = pandas.DataFrame(run.table)
    late = epochs[epochs.steps > epochs.steps.iloc[-1] - last]
    since = epochs[epochs.steps > start]
    spans = since.groupby(np.ceil(since.steps / SPAN)).episode_cost.mean().dropna()
    return {
        "return": late.episode_return.mean(),
        "cost": late.episode_cost.mean(),
        "since": since.episode_cost.mean(),
        "above": (spans > LIMIT).mean(),
        "rate": epochs.cost_rate.iloc[-1],
        "tail": late.get("violation_cost", late.cost_rate).mean() + run.cost_limits.get("cost", 0),
    }


def summary(
    group: pandas.DataFrame, last: float, start: float = 0, digits: int = 1
) -> dict[str, Any]:
    """Cells of a row: means of the figures of some runs, with deviations among their seeds."""
    of_runs = pandas.DataFrame([figures(run, last, start) for run in group.run])
    mean, spread = of_runs.mean(), of_runs.std().fillna(0)

    def both(name: str, digits: int) -> str:
        deviation = f" ± {spread[name]:.{digits}f}" if len(group) > 1 else ""
        return f"{mean[name]:.{digits}f}{deviation}"

    return {
        **group.iloc[0][["environment", "name"]],
        "algorithm": f"`{group.iloc[0].algorithm}`",
        "steps": f"{group.iloc[0].run.table['steps'][-1] / MILLION:.2g}M",
        "seeds": len(group),
        "cost": both("cost", 1),
        "return": both("return", digits),
        "since": f"{mean.since:.1f}",
        "above": f"{100 * mean.above:.0f} %",
        "rate": f"{mean['rate']:.3f}",
        "tail": f"{mean['tail']:.0f}",  # if a CVaR is limited
        "certified": certified(group),
        "new": new_episodes(group),
    }


def summaries(campaign: str, *given: float, by: Iterable[str] = _CELL) -> Rows:
    """A row for every group of runs of a campaign."""
    return [summary(group, *given) for _, group in runs(campaign).groupby([*by], sort=False)]


def certified(group: pandas.DataFrame) -> str:
    """How many of the tested runs are certified, and at which returns."""
    told = [run.notes["certificate"] for run in group.run if run.notes.get("certificate")]
    returns = sorted(each["episode_return"] for each in told if each["certified"])
    ends = dict.fromkeys(f"{value:.1f}" for value in returns[:1] + returns[-1:])
    at = f", at {' to '.join(ends)}" if ends else ""
    return f"{len(returns)} of {len(told)}{at}" if told else "—"


def new_episodes(group: pandas.DataFrame) -> str:
    """Mean costs of certified policies in 2,000 new episodes, and the highest interval end."""
    tests = [test for run in group.run for test in run.notes.get("evaluations", ())]
    costs = [t["estimates"]["episode_cost"] for t in tests if t["checkpoint"] == "certified"]
    ends = dict.fromkeys(f"{f(c['value'] for c in costs):.1f}" for f in (min, max) if costs)
    return f"{' to '.join(ends)} ({max(c['high'] for c in costs):.1f})" if costs else "—"


def markdown(heads: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table in Markdown; bars within cells become broken bars."""
    heads = list(heads)
    return "\n".join(
        f"| {' | '.join(str(cell).replace('|', '¦') for cell in line)} |"
        for line in (heads, ["---"] * len(heads), *rows)
    )


def table(rows: Iterable[Mapping[str, Any]], *columns: str) -> str:
    """A table of some columns of rows."""
    cells = ([row[key] for key in columns] for row in rows)
    return markdown((HEADS.get(name, name) for name in columns), cells)


def three_million(campaign: str) -> str:
    """Runs of a campaign on held-out seeds after three million steps."""
    return table(summaries(campaign, MILLION / 2, MILLION), *_LONG)


_SHORT = ("cost", "return", "above", "rate", "certified", "seeds")
_LONG = (*_CELL, "cost", "return", "rate", "certified", "since", "above", "new", "seeds")


def compared(env: str) -> str:
    """All algorithms in one environment after a million steps."""
    rows = summaries("algorithms", MILLION / 4, 3 * MILLION / 4)
    return table([row for row in rows if row["environment"] == env], "algorithm", *_SHORT)


def measured(algo: str) -> str:
    """Runs of an algorithm with its default settings, a row for each environment and length."""
    rows = summaries("algorithms", MILLION / 4, 3 * MILLION / 4)
    rows += summaries("held_out", MILLION / 2, MILLION)
    rows = [row for row in rows if row["algorithm"] == f"`{algo}`"]
    explained = "Limit 25, default settings. [What the columns mean](index.md#compared)."
    return f"{explained}\n\n{table(rows, 'environment', 'steps', *_SHORT)}"


def single(campaign: str) -> str:
    """Runs of a campaign one by one: how they got there, their ends, and their certificates."""
    rows, times = [], [0, 250_000, 500_000, MILLION, 2 * MILLION]
    names = [f"to {end / MILLION:g}M" for end in times[1:]]
    for _, found in runs(campaign).iterrows():
        run, epochs = found.run, pandas.DataFrame(found.run.table)
        parts = epochs.groupby(pandas.cut(epochs.steps, times, labels=names), observed=False)
        means = parts[["episode_cost", "episode_return"]].mean()
        row = summary(found.to_frame().T, MILLION / 2) | {"seed": found.seed}
        row |= {n: "" if np.isnan(c) else f"{c:.0f} / {r:.1f}" for n, c, r in means.itertuples()}
        told = run.notes.get("certificate") or {}
        missed = (told.get("shortfalls") or {}).get("mean_cost")
        row["bound"] = f"no, by {missed:.1f}" if missed else "—"
        if told.get("certified"):
            claim = f"≤ {rounded_up(told['bounds']['mean_cost']['bound']):.1f}"
            if stops_within_limit(run.settings.get("transforms") or {}):
                claim = "by construction,"
            row["bound"] = f"{claim} at {told['episode_return']:.1f}"
        rows.append(row)
    differ = [key for key in ("name", "algorithm") if len({row[key] for row in rows}) > 1]
    names = [name for name in names if any(row[name] for row in rows)]
    ends = ("cost", *(["tail"] if campaign == "cvar" else []), "return", "rate", "bound")
    return table(rows, "environment", *differ, "seed", *ends, "steps", *names)


def stops_within_limit(transforms: Mapping[str, Any]) -> bool:
    """Whether every episode ends before its cost can exceed the limit; a step costs at most 1."""
    termination = transforms.get("early_termination", {"budgets": {}})
    budget = termination["budgets"].get("cost", np.inf)
    return budget + 1 <= LIMIT and termination["in_evaluation"]


def parts() -> str:
    """PPO-Lagrangian without one part of how it holds the limit, after three million steps."""
    epochs = pandas.read_csv(ROOT / "results" / "parts" / "three_million.csv.gz")
    rows: Rows = []
    for (what, env), found in epochs.groupby(["without", "env"], sort=False):
        ends = found[found.steps > 2 * MILLION].groupby("seed")[["episode_cost", "episode_return"]]
        cost, earned = (f"{of.mean():.1f} ± {of.std():.1f}" for _, of in ends.mean().items())
        above = (found[found.steps > MILLION].episode_cost > LIMIT).mean()
        rows.append({"without": what, "environment": env, "cost": cost, "return": earned})
        rows[-1]["above"] = f"{100 * above:.0f} %"
    return table(rows, "without", "environment", "cost", "return", "above")


def rivals() -> str:
    """Published values of other implementations beside ours, favourable or not."""
    told = yaml.safe_load((ROOT / "safe_rl" / "scores" / "published.yaml").read_text())
    rows = [row for name in _THREE_MILLION for row in summaries(name, MILLION / 2)]
    for row in rows:
        env, algo = row["environment"], row["algorithm"].strip("`")
        theirs = told["reimplementations"]["scores"].get(env, {}).get(algo)
        paper = told["reference"][env]["scores"] if algo == "ppo" else None
        for name, pair in (("omnisafe", theirs), ("paper", paper)):
            row[name] = f"{pair[1]:.1f} / {pair[0]:.1f}" if pair else "—"
    rows.sort(key=lambda row: [*SUITE].index(row["environment"]))
    return table(rows, "environment", "algorithm", "cost", "return", "omnisafe", "paper", "seeds")


def paper_tables() -> str:
    """The paper's Tables 1 and 2 from our runs of three million steps."""
    found = [run for name in _THREE_MILLION for run in runs(name).run]
    made = paper_table(group_runs(found, suite())[0])
    return markdown(made.columns, [[cell.text for cell in row] for row in made.rows()])


def paper_preset() -> str:
    """Runs with the paper's preset, over the last five epochs."""
    rows = summaries("paper_preset", 5 * 30_000, by=("name", "algorithm"))
    return table(rows, "algorithm", "cost", "return", "rate", "steps", "seeds")


def velocity_runs() -> str:
    """PPO-Lagrangian below limits of speed, beside what OmniSafe publishes."""
    rows = summaries("velocity", MILLION / 4, 3 * MILLION / 4, 0)
    rows = [row | {"omnisafe": OMNISAFE[row["environment"]]} for row in rows]
    return table(rows, "environment", "cost", "return", "above", "omnisafe", "seeds")


def coverage() -> str:
    """What each environment of the benchmark has: seeds × million steps of finished runs."""
    own = ("algorithms", "doggo", *_THREE_MILLION)
    found = pandas.concat([runs(name).query("name == ''").assign(what="own") for name in own])
    others = {"held_actions": "`preset=hard_tasks`", "privileged": "`preset=privileged`"}
    others |= {"paper_preset": "paper's settings"}
    found = pandas.concat([found, *(runs(name).assign(what=what) for name, what in others.items())])
    found = found[[run.is_finished for run in found.run]]
    shown = [*ALGORITHMS, "sac_lagrangian", "td3_lagrangian"]
    rows: Rows = []
    for env in (name for name in SUITE if not name.endswith("0")):
        here = found[found.environment == env]
        row = {name: seeds(here.query("what == 'own' and algorithm == @name")) for name in shown}
        rest = here.query("what == 'own' and algorithm not in @shown")
        row["others"] = seeds(rest, by_name=True)
        row |= {what: seeds(here[here.what == what], by_name=True) for what in others.values()}
        rows.append({"environment": env} | {name: cell or "—" for name, cell in row.items()})
    return markdown((f"`{n}`" if n in shown else n for n in rows[0]), (r.values() for r in rows))


def seeds(group: pandas.DataFrame, *, by_name: bool = False) -> str:
    """Seeds × million steps of some runs: ``5 × 3M, 3 × 1M``; ``by_name`` with their algorithms."""
    lengths = [-round(run.steps / MILLION, 1) for run in group.run]
    cells: dict[tuple[float, int], list[str]] = {}
    for (length, algo), own in group.assign(length=lengths).groupby(["length", "algorithm"]):
        cells.setdefault((length, own.seed.nunique()), []).append(f"`{algo}`")
    return ("; " if by_name else ", ").join(
        f"{n} × {-length:g}M" + (f": {', '.join(names)}" if by_name else "")
        for (length, n), names in cells.items()
    )


def readme() -> str:
    """README's table: cost, return, cost rate, a row per algorithm, a column per environment."""
    found = pandas.concat([runs("reference").query("algorithm == 'ppo'"), runs("held_out")])
    rows: Rows = []
    for algo, of_algo in found.groupby("algorithm", sort=False):
        row = {"algorithm": f"`{algo}`", "certified": certified(of_algo).partition(",")[0]}
        for env, group in of_algo.groupby("environment"):
            mean = pandas.DataFrame([figures(run, MILLION / 2) for run in group.run]).mean()
            row[env] = f"{mean['cost']:.1f}, {mean['return']:.1f}, {mean['rate']:.3f}"
        rows.append(row)
    return table(rows, "algorithm", *dict.fromkeys(found.environment), "certified").replace(
        HEADS["certified"], "certified"
    )


TABLES = (three_million, rivals, paper_preset, coverage, compared, measured, single, parts)
TABLES += (velocity_runs, paper_tables, readme)
