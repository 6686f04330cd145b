"""Tables of results for the pages, made from the archived runs in ``results/``.

A page has a mark where a table goes: ``<!-- made: held_out -->``. README's table is stored in the
page; ``python docs/_site/result_tables.py`` writes it again.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
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
from safe_rl.reporting.slates import paper_table

ROOT = Path(__file__).resolve().parents[2]
LIMIT, SPAN, MILLION = 25.0, 20_000, 1_000_000
TIMES = (250_000, 500_000, 1_000_000, 2_000_000)
# The columns "PPOLag" of Table 2 of OmniSafe's benchmarks/on-policy/README.md, commit 005e482:
# return and episode cost, each with its deviation.
OMNISAFE = {
    "SafeAntVelocity": ("3262 ± 80", "12.1 ± 6.6"),
    "SafeHalfCheetahVelocity": ("2946 ± 306", "3.4 ± 4.8"),
    "SafeHopperVelocity": ("962 ± 753", "14.0 ± 19.3"),
    "SafeHumanoidVelocity": ("6624 ± 26", "5.9 ± 9.5"),
    "SafeSwimmerVelocity": ("65 ± 18", "28.0 ± 4.1"),
    "SafeWalker2dVelocity": ("2982 ± 682", "13.5 ± 14.6"),
}


@cache
def runs(campaign: str) -> pandas.DataFrame:
    """Runs of a campaign: environment, algorithm, name of the setting or "", seed, and the run."""
    found = []
    for path, run in read_archive(ROOT / "results" / campaign).items():
        env, algo, *name, seed = path.split("/")
        found.append((env, algo, "/".join(name), int(seed.removeprefix("seed")), run))
    order = {env: place for place, env in enumerate(SUITE)}
    found.sort(key=lambda entry: (order.get(entry[0], 0), *entry[:4]))
    return pandas.DataFrame(found, columns=["environment", "algorithm", "name", "seed", "run"])


def figures(run: Any, last: float, start: float = 0) -> dict[str, float]:
    """Figures of a run.

    Args:
        run: An archived run.
        last: Number of steps at its end over which return and cost are averaged.
        start: Step from which on costs are compared with the limit.

    Returns:
        ``return`` and ``cost`` of an episode, ``since`` (cost from `start` on), ``above`` (share of
        the spans of 20,000 steps from `start` on whose mean cost is above the limit), ``rate``
        (cost of a step of the whole run).
    """
    table = pandas.DataFrame(run.table)
    late = table[table.steps > table.steps.iloc[-1] - last]
    since = table[table.steps > start]
    spans = since.groupby(np.ceil(since.steps / SPAN)).episode_cost.mean().dropna()
    return {
        "return": late.episode_return.mean(),
        "cost": late.episode_cost.mean(),
        "since": since.episode_cost.mean(),
        "above": (spans > LIMIT).mean(),
        "rate": table.cost_rate.iloc[-1],
    }


def means(
    group: pandas.DataFrame, last: float, start: float = 0, digits: int = 1
) -> dict[str, str]:
    """Cells of a row: means of the figures of some runs, with deviations among their seeds."""
    of_runs = pandas.DataFrame([figures(run, last, start) for run in group.run])
    mean, spread = of_runs.mean(), of_runs.std()
    cells = {
        name: f"{mean[name]:.{n}f}" + f" ± {spread[name]:.{n}f}" * (len(group) > 1)
        for name, n in (("return", digits), ("cost", 1))
    }
    cells |= {"since": f"{mean.since:.1f}", "above": f"{mean.above:.0%}".replace("%", " %")}
    return {"seeds": str(len(group)), **cells, "rate": f"{mean['rate']:.3f}"}


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
    if not costs:
        return "—"
    ends = dict.fromkeys(f"{f(cost['value'] for cost in costs):.1f}" for f in (min, max))
    return f"{' to '.join(ends)} ({max(cost['high'] for cost in costs):.1f})"


def table(head: Mapping[str, str] | list[str], rows: list[Any]) -> str:
    """A table in Markdown: of rows of cells, or of mappings from the keys of `head`."""
    keys = list(head)
    heads = list(head.values()) if isinstance(head, Mapping) else keys
    cells = [[row[key] for key in keys] if isinstance(row, Mapping) else row for row in rows]
    lines = [heads, ["---"] * len(heads), *cells]
    return "\n".join(
        f"| {' | '.join(str(cell).replace('|', '¦') for cell in line)} |" for line in lines
    )


HEAD = {
    "cost": "episode cost", "return": "return", "above": "above 25", "rate": "$\\rho_c$",
    "certified": "certified",
}  # fmt: skip


def held_out() -> str:
    """Constrained algorithms on held-out seeds after three million steps."""
    head = {"environment": "environment", "algorithm": "`algo=`", "seeds": "seeds"}
    head |= {"cost": "episode cost", "return": "return", "since": "cost from 1M"}
    head |= {"above": "above 25 from 1M", "rate": "$\\rho_c$"}
    head |= {"certified": "certified, at returns of", "new": "new episodes"}
    rows = []
    for (env, algo), group in runs("held_out").groupby(["environment", "algorithm"], sort=False):
        row = means(group, MILLION / 2, MILLION)
        row |= {"environment": env, "algorithm": f"`{algo}`"}
        rows.append(row | {"certified": certified(group), "new": new_episodes(group)})
    return table(head, rows)


def compared(env: str) -> str:
    """All algorithms in one environment after a million steps."""
    rows = [
        _row(group, algo)
        for algo, group in runs("algorithms").query("environment == @env").groupby("algorithm")
    ]
    head = {"algorithm": f"{env}, `algo=`", "seeds": "seeds", **HEAD}
    return table(head, rows)


def _row(group: pandas.DataFrame, algo: str) -> dict[str, str]:
    row = means(group, MILLION / 4, 3 * MILLION / 4)
    return row | {"algorithm": f"[`{algo}`]({algo}.md)", "certified": certified(group)}


def measured(algo: str) -> str:
    """Runs of an algorithm with its default settings, a row for each environment and length."""
    rows = []
    for campaign, million in (("algorithms", 1), ("held_out", 3)):
        found = runs(campaign)
        for env, group in found[found.algorithm == algo].groupby("environment"):
            last, start = (0.25, 0.75) if million == 1 else (0.5, 1)
            row = means(group, last * MILLION, start * MILLION)
            row |= {"environment": env, "steps": f"{million}M"}
            rows.append(row | {"certified": certified(group)})
    if not rows:
        return "No results yet."
    head = {"environment": "environment", "steps": "steps", "seeds": "seeds", **HEAD}
    explained = "Limit 25, default settings. [What the columns mean](index.md#compared)."
    return f"{explained}\n\n{table(head, rows)}"


def single(campaign: str) -> str:
    """Runs of a campaign one by one: their ends, their certificates, and how they got there."""
    rows = []
    for _, found in runs(campaign).iterrows():
        steps, early = pandas.DataFrame(found.run.table), []
        for low, high in zip((0, *TIMES), TIMES, strict=False):
            part = steps[(steps.steps > low) & (steps.steps <= high)]
            pair = f"{part.episode_cost.mean():.0f} / {part.episode_return.mean():.1f}"
            early.append(pair if len(part) else "")
        certificate = found.run.notes.get("certificate") or {}
        if certificate.get("certified"):
            bound = certificate["bounds"]["mean_cost"]["bound"]
            end = f"≤ {bound:.1f} at {certificate['episode_return']:.1f}"
        else:
            end = f"no, by {certificate['shortfalls']['mean_cost']:.1f}" if certificate else "—"
        row = means(found.to_frame().T, MILLION / 2)
        row |= {
            "environment": found.environment,
            "seed": str(found.seed),
            "name": f"`{found['name']}`",
        }
        row |= {"million": f"{found.run.steps / MILLION:g}M", "certified": end}
        rows.append(row | dict(zip(map(str, TIMES), early, strict=True)))
    head = {"environment": "environment"}
    if campaign == "one_transform":
        head |= {"name": "transform"}
    head |= {"seed": "seed", "million": "steps"}
    head |= {str(n): f"to {n / MILLION:g}M" for n in TIMES}
    head |= {"cost": "cost", "return": "return", "rate": "$\\rho_c$", "certified": "certified"}
    return table(head, rows)


PARTS = {
    "nothing": "nothing: the defaults",
    "free steps and descent": "free steps, descent: `limits.free_steps=0 limits.descent_steps=0`",
    "margin": "margin: `limits.margin=0`",
    "gains": "gains: `lagrangian=pid`",
    "weighing against the past": "weighing against the past: `limits.drift=10`",
    "clipped costs": "clipped costs: `loss.cost_clipping=none`",
}


def parts() -> str:
    """PPO-Lagrangian without one part of how it holds the limit."""
    epochs = pandas.read_csv(ROOT / "results" / "parts" / "three_million.csv.gz")
    rows = []
    for what, said in PARTS.items():
        cells = [said]
        for env in ("PointGoal1", "CarGoal1"):
            found = epochs[(epochs["without"] == what) & (epochs.env == env)]
            end, late = found[found.steps > 2 * MILLION], found[found.steps > MILLION]
            ends = end.groupby("seed")[["episode_cost", "episode_return"]].mean()
            mean, spread = ends.mean(), ends.std()
            cells += [f"{mean[name]:.1f} ± {spread[name]:.1f}" for name in ends]
            cells.append(f"{(late.episode_cost > LIMIT).mean():.0%}".replace("%", " %"))
        rows.append(cells)
    head = ["without", "PointGoal1: cost", "return", "above 25", "CarGoal1: cost", "return"]
    return table([*head, "above 25"], rows)


def rivals() -> str:
    """Published values of other implementations beside ours, favourable or not."""
    told = yaml.safe_load((ROOT / "safe_rl" / "scores" / "published.yaml").read_text())
    ours, rows = pandas.concat([runs("reference"), runs("held_out")]), []
    for env in dict.fromkeys(ours.environment):
        for algo, group in ours[ours.environment == env].groupby("algorithm"):
            row = means(group, MILLION / 2)
            known = [told["reimplementations"]["scores"].get(env, {}).get(algo)]
            known.append(told["reference"][env]["scores"] if algo == "ppo" else None)
            theirs = [f"{each[1]:.1f} / {each[0]:.1f}" if each else "—" for each in known]
            rows.append([env, f"`{algo}`", f"{row['cost']} / {row['return']}", *theirs])
    head = ["environment", "`algo=`", "ours, 3M steps", "OmniSafe, 10M", "Ray et al. (2019), 10M"]
    return table(head, rows)


def paper_tables() -> str:
    """The paper's Tables 1 and 2 from our runs of three million steps."""
    found = [run for name in ("held_out", "reference") for run in runs(name).run]
    made = paper_table(group_runs(found, suite())[0])
    return table(list(made.columns), [[cell.text for cell in row] for row in made.rows()])


def paper_preset() -> str:
    """Runs with the paper's preset, over the last five epochs."""
    rows = []
    for (algo, name), group in runs("paper_preset").groupby(["algorithm", "name"]):
        row = means(group, 5 * 30_000)
        million = f"{group.run.iloc[0].steps / MILLION:.0f}M"
        rows.append(row | {"algorithm": f"`{name or algo}`", "steps": million})
    head = {"algorithm": "`algo=`", "steps": "steps", "seeds": "seeds"}
    return table(head | {"cost": "episode cost", "return": "return", "rate": "$\\rho_c$"}, rows)


def velocity_runs() -> str:
    """PPO-Lagrangian below limits of speed, beside what OmniSafe publishes."""
    head = {"environment": "`env=`", "seeds": "seeds", "cost": "cost", "return": "return"}
    head |= {"above": "above 25", "theirs_cost": "OmniSafe, 10M steps: cost", "theirs": "return"}
    rows = []
    for env, (theirs, cost) in OMNISAFE.items():
        row = means(runs("velocity").query("environment == @env"), MILLION / 4, 3 * MILLION / 4, 0)
        rows.append(row | {"environment": f"`{env}`", "theirs": theirs, "theirs_cost": cost})
    return table(head, rows)


def coverage() -> str:
    """Which environments of the benchmark have runs: number of seeds, by algorithm and length."""
    campaigns = {"algorithms": "1M", "held_out": "3M", "reference": "3M", "held_actions": "hard"}
    campaigns |= {"paper_preset": "paper", "doggo": "other"}
    found = pandas.concat([runs(name).assign(what=said) for name, said in campaigns.items()])
    found.loc[found.algorithm == "one_million", "algorithm"] = "cpo, trpo, …"
    rows = []
    for env in SUITE:
        of_env = found[found.environment == env]
        cells = [
            ", ".join(
                f"{algo} ({seeds.nunique()})" for algo, seeds in of_what.groupby("algorithm").seed
            )
            for of_what in (
                of_env[of_env.what == said] for said in dict.fromkeys(campaigns.values())
            )
        ]
        if not env.endswith("0"):
            rows.append([env, *(cell or "—" for cell in cells)])
    head = ["environment", "defaults, 1M steps", "defaults, 3M", "`hard_tasks`", "`paper`", "other"]
    return table(head, rows)


def readme() -> str:
    """README's table: cost, return, cost rate, a row per algorithm, a column per environment."""
    found = pandas.concat([runs("reference").query("algorithm == 'ppo'"), runs("held_out")])
    names = list(dict.fromkeys(found.environment))
    rows = []
    for algo in dict.fromkeys(found.algorithm):
        of_algo = found[found.algorithm == algo]
        cells = [
            f"{row['cost']:.1f}, {row['return']:.1f}, {row['rate']:.3f}"
            for env in names
            for row in [
                pandas.DataFrame(
                    [figures(run, MILLION / 2) for run in of_algo[of_algo.environment == env].run]
                ).mean()
            ]
        ]
        rows.append([f"`{algo}`", *cells, certified(of_algo).partition(",")[0]])
    return table(["`algo=`", *names, "certified"], rows)


def fill_readme(text: str) -> str:
    """README with its table made again."""
    mark = "<!-- table of docs/_site/result_tables.py -->\n"
    return re.sub(f"(?<={mark})(\\|.*\n)+", lambda _: readme() + "\n", text)


TABLES = (
    held_out,
    rivals,
    paper_tables,
    paper_preset,
    coverage,
    compared,
    measured,
    single,
    parts,
    velocity_runs,
)


if __name__ == "__main__":
    page = ROOT / "README.md"
    page.write_text(fill_readme(page.read_text()))
