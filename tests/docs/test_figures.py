"""Figures that README and the pages name are those of the archived runs."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pandas
import pytest

from safe_rl.reporting.archive import read_archive

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "results"
README = (ROOT / "README.md").read_text()
PAGE = (ROOT / "docs" / "results.md").read_text()
ALGORITHMS = (ROOT / "docs" / "algorithms" / "index.md").read_text()
HOLDING = (ROOT / "docs" / "algorithms" / "holding_the_limit.md").read_text()
OFF_POLICY = (ROOT / "docs" / "off_policy.md").read_text()


def sentences(page):
    """A page without its line breaks."""
    return " ".join(page.split())


ONE_COMMIT = r"^\| (\w+) \| `(\w+)` \| (\d) \| (.+) \|$"
ENVIRONMENTS = ("PointGoal1", "CarGoal1")
OFF_POLICY_ONES = ("cal", "sac_lagrangian", "td3_lagrangian")


@cache
def campaign(name):
    return read_archive(RESULTS / name)


def run_at(path):
    """The archived run whose path this is, if there is one."""
    name, *below = path.relative_to(RESULTS).parts
    return campaign(name).get("/".join(below))


def seeds_of(folder):
    """Paths of the archived runs of an environment and an algorithm."""
    name, env, algo = folder.relative_to(RESULTS).parts
    return [RESULTS / name / p for p in campaign(name) if p.startswith(f"{env}/{algo}/seed")]


def figures(folder):
    """Steps, returns and costs of a run, by epochs."""
    columns = run_at(folder).table
    return [np.array(columns[name]) for name in ("steps", "episode_return", "episode_cost")]


def last(folder, share):
    """Mean return and cost of the last `share` of a run."""
    steps, returns, costs = figures(folder)
    late = steps > steps[-1] * (1 - share)
    return np.nanmean(returns[late]), np.nanmean(costs[late])


def held(folder, start=1_000_000):
    """Mean cost after so many steps, and the share of spans of 20,000 that cost more than 25."""
    steps, _, costs = figures(folder)
    spans = [
        costs[(steps > end - 20_000) & (steps <= end)]
        for end in range(start + 20_000, int(steps[-1]) + 1, 20_000)
    ]
    return np.nanmean(costs[steps > start]), np.mean([np.nanmean(span) > 25 for span in spans])


def certificate(folder, what="≤ {:.1f} at {:.1f}"):
    told = run_at(folder).notes["certificate"]
    if told["certified"]:
        return what.format(told["bounds"]["mean_cost"]["bound"], told["episode_return"])
    return f"no, by {told['shortfalls']['mean_cost']:.1f}"


def kept(folders):
    """How many runs ended with a certificate, and at which returns."""
    told = [run_at(folder).notes["certificate"] for folder in folders]
    returns = sorted(run["episode_return"] for run in told if run["certified"])
    ends = dict.fromkeys(f"{value:.1f}" for value in returns[:1] + returns[-1:])
    return f"{len(returns)} of {len(told)}" + f", at {' to '.join(ends)}" * bool(ends)


def percent(share):
    return f"{share:.0%}".replace("%", " %")


def cells_of(folders):
    """A row of the table of three million steps."""
    of_runs = np.array([last(folder, 1 / 6) for folder in folders])
    final = [f"{mean:.1f}" for mean in of_runs.mean(0)]
    if len(folders) > 1:
        final = [f"{m} ± {d:.1f}" for m, d in zip(final, of_runs.std(0, ddof=1), strict=True)]
    mean_cost, above = np.mean([held(folder) for folder in folders], axis=0)
    return [" / ".join(final), f"{mean_cost:.1f}", percent(above), kept(folders)]


@pytest.mark.parametrize("algo", OFF_POLICY_ONES)
def test_the_limit_from_200_000_steps_on(algo):
    cells = []
    for env in ENVIRONMENTS:
        runs = seeds_of(RESULTS / "algorithms" / env / algo)
        cost, above = np.mean([held(run, 200_000) for run in runs], axis=0)
        cells.append(f"{cost:.1f}, {percent(above)}")
    assert f"| `{algo}` | {' | '.join(cells)} |\n" in OFF_POLICY


@pytest.mark.parametrize("algo", [*OFF_POLICY_ONES, "sac", "td3", "wcsac"])
def test_a_million_steps_with_a_replay_buffer(algo):
    ends = [means(seeds_of(RESULTS / "algorithms" / env / algo), 0.25) for env in ENVIRONMENTS]
    assert f"| `{algo}` | {' | '.join(ends)} |\n" in OFF_POLICY


@pytest.mark.parametrize("env", ["PointGoal1", "PointGoal2"])
def test_how_much_too_high_the_cost_critics_of_sac_lagrangian_are(env):
    spans = []
    for run in seeds_of(RESULTS / "held_out" / env / "sac_lagrangian"):
        values = run_at(run).table["policy_cost_qvalue"][-100:]  # half a million steps
        # discounted costs of 0.99 and episodes of 1,000 steps
        spans.append((np.mean(values) * 1000 * (1 - 0.99), last(run, 1 / 6)[1]))
    said, paid = ([f"{f(x):.0f}" for f in (min, max)] for x in zip(*spans, strict=True))
    words = rf"{said[0]} to {said[1]} on {env}, where (episodes|they) cost {paid[0]} to {paid[1]}\b"
    assert re.search(words, sentences(OFF_POLICY))


def test_a_million_steps_on_policy():
    algos = ("ppo_lagrangian", "trpo_lagrangian", "cpo", "pcpo")
    runs = [seeds_of(RESULTS / "algorithms" / "PointGoal1" / algo) for algo in algos]
    costs = sorted(means(of_algo, 0.25, "{1:.1f}") for of_algo in runs)
    said = "`, `".join(algos) + f"`: on PointGoal1 their mean costs are {costs[0]} to {costs[-1]}"
    assert said in ALGORITHMS
    assert {kept(of_algo).partition(",")[0] for of_algo in runs} == {"2 of 3"}


def quarters_of(steps, returns, costs):
    """Means over each quarter million of steps."""
    quarters = (steps - 1) // 250_000
    ends = [[np.nanmean(of[quarters == q]) for of in (returns, costs)] for q in np.unique(quarters)]
    return tuple("{:.1f} / {:.0f}".format(*end) for end in ends)


def test_quarters_of_harder_tasks():
    pattern = r"^\| (\w+) \| `(\w+)` \| ((?:[^|]+ / [^|]+ \| ){4}no, by \S+) \|$"
    rows = re.findall(pattern, OFF_POLICY, re.MULTILINE)
    assert len(rows) == 3
    for env, algo, cells in rows:
        folder = RESULTS / "off_policy" / env / algo / "seed401"
        quarters = quarters_of(*figures(folder))
        assert cells.split(" | ") == [*quarters, certificate(folder)]


# campaign of exploration -> steps of the environment per logged step: one counted decisions
TRIED = {"hard_tasks": 4, "held_actions": 1, "one_transform": 1}


def test_quarters_of_what_was_tried_on_hard_tasks():
    page = (ROOT / "docs" / "algorithms" / "hard_tasks.md").read_text()
    rows = re.findall(r"^\| (?:.+ \| )?`([\w.]+)` \| ((?:[^|]+ / [^|]+ \|)+)", page, re.MULTILINE)
    runs = [(name, path) for name in TRIED for path in campaign(name)]
    assert len(rows) == len(runs)
    told = {(name, tuple(cell.strip() for cell in cells.split("|")[:-1])) for name, cells in rows}
    for name, path in runs:
        steps, returns, costs = figures(RESULTS / name / path)
        cells = quarters_of(TRIED[name] * steps, returns, costs)
        assert (Path(path).parts[2], cells) in told


HARD = r"^\| (\w+) \| (\d+) \| (\d) million \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$"
TESTED = {"PointGoal2": (1321, 2201, 4420), "PointPush1": (1321, 2201)}  # by new episodes


def test_the_ends_of_the_runs_on_hard_tasks():
    page = (ROOT / "docs" / "algorithms" / "hard_tasks.md").read_text()
    rows = re.findall(HARD, page, re.MULTILINE)
    assert len(rows) == len(campaign("held_actions"))
    for env, seed, millions, *cells in rows:
        run = RESULTS / f"held_actions/{env}/sac_lagrangian/lead/seed{seed}"
        steps = int(millions) * 1_000_000
        assert figures(run)[0][-1] == steps
        final = "{:.1f} / {:.1f}".format(*last(run, 500_000 / steps))
        above = percent(held(run, steps - 500_000)[1])
        assert cells == [final, above, certificate(run)]
    for env, seeds in TESTED.items():
        paths = f"held_actions/{env}/sac_lagrangian/lead/seed"
        *runs, old = (RESULTS / f"{paths}{n}" for n in (*seeds, 6951))
        *costs, end = (new_episodes([run]).split()[0] for run in runs)
        assert f"mean costs of {', '.join(costs)} and {end}" in sentences(page)
        returns = sorted(float(certificate(run, "{1:.1f}")) for run in (*runs, old))
        assert f"{returns[0]} to {returns[-1]} on {env}" in sentences(README)


def means(folders, share, form="{:.1f} / {:.1f}"):
    return form.format(*np.mean([last(folder, share) for folder in folders], axis=0))


@pytest.mark.parametrize("env", [*ENVIRONMENTS, "PointGoal2", "PointButton1", "PointPush1"])
def test_means_without_a_limit(env):
    form = "{:.1f} / {:.0f}"
    ends = [means(seeds_of(RESULTS / "reference" / env / a), 1 / 6, form) for a in ("ppo", "trpo")]
    assert f"| {env} | {' | '.join(ends)} |" in PAGE
    assert f"| {env} | {ends[0]} |" in README


def test_the_table_of_readme_is_a_part_of_the_full_ones():
    full = {(e, a): (n, cells) for e, a, n, cells in re.findall(ONE_COMMIT, PAGE, re.M)}
    rows = re.findall(r"^\| (\w+) \| .* \| `(\w+)` \| (\d) \| (.+) \|$", README, re.M)
    assert len(rows) == 7
    for env, algo, count, cells in rows:
        number, told = full[env, algo]
        end, _, above, certified, *_ = told.split(" | ")
        assert [count, *cells.split(" | ")] == [number, end, above, certified.split(",")[0]]


def new_episodes(folders):
    """Mean costs of certified policies in new episodes, and the highest end of their intervals."""
    runs = [run.notes for run in map(run_at, folders) if run.notes["certificate"]["certified"]]
    if not runs:
        return "none"
    tests = [test for notes in runs for test in notes["evaluations"]]
    assert [(t["checkpoint"], t["episodes"]) for t in tests] == [("certified", 2000)] * len(runs)
    costs = [test["estimates"]["episode_cost"] for test in tests]
    ends = dict.fromkeys(f"{f(c['value'] for c in costs):.1f}" for f in (min, max))
    return f"{' to '.join(ends)} ({max(c['high'] for c in costs):.1f})"


def test_the_campaign_at_one_commit():
    everything, runs, highest = campaign("held_out").values(), 0, []
    for env, algo, count, cells in re.findall(ONE_COMMIT, PAGE, re.MULTILINE):
        folders = seeds_of(RESULTS / "held_out" / env / algo)
        runs += len(folders)
        assert int(count) == len(folders)
        new = new_episodes(folders)
        assert cells.split(" | ") == [*cells_of(folders), new]
        highest += map(float, re.findall(r"([\d.]+) \(", new))
    assert runs == len(everything)
    certified = sum(run.notes["certificate"]["certified"] for run in everything)
    assert f"{certified} of the {runs} runs are certified" in PAGE
    assert f"certifies {certified} of {runs} runs" in sentences(README)
    assert f"mean costs of at most {max(highest)} in 2,000" in sentences(README)
    for algo in ("ppo_lagrangian", "trpo_lagrangian", "cpo"):
        told = kept([RESULTS / "held_out" / p for p in campaign("held_out") if f"/{algo}/" in p])
        page = (ROOT / "docs" / "algorithms" / f"{algo}.md").read_text()
        assert f"{told.partition(',')[0]} runs of" in sentences(page)


def test_what_the_page_of_td3_lagrangian_says_of_two_tasks():
    ends = {}
    for env, algo in (("PointPush1", "sac"), ("PointPush1", "td3"), ("PointGoal2", "td3")):
        runs = seeds_of(RESULTS / "held_out" / env / f"{algo}_lagrangian")
        ends[env, algo] = cells_of(runs)[0].replace(" ± ", " / ").split(" / ")
    page = sentences((ROOT / "docs" / "algorithms" / "td3_lagrangian.md").read_text())
    of_sac, of_td3 = (" ± ".join(ends["PointPush1", algo][:2]) for algo in ("sac", "td3"))
    assert f"{of_sac}, against {of_td3} of TD3-Lagrangian" in page
    mean_return, _, cost, _ = ends["PointGoal2", "td3"]
    assert f"the mean return was {mean_return} and the mean cost {cost}." in page


def test_the_first_command_of_readme():
    runs = [RESULTS / "first_million" / p for p in campaign("first_million") if "/betting/" in p]
    returns, costs = kept(runs).removeprefix("6 of 6, at "), new_episodes(runs).partition(" (")[0]
    six = "In 2,000 new episodes these six policies have mean costs of"
    assert f"at returns of {returns}. {six} {costs}." in sentences(PAGE)


def test_the_last_five_epochs_of_the_paper_preset():
    whole = {}
    for path, run in campaign("paper_preset").items():
        table, algo = run.table, Path(path).parts[-2]
        scores = [np.mean(table[f"episode_{of}"][-5:]) for of in ("return", "cost")]
        scores.append(table["cost_rate"][-1])
        if table["steps"][-1] > 5e6:
            whole.setdefault(algo, []).append(scores)
        else:
            assert "| `{}` | {:.1f} | {:.1f} | {:.3f} |".format(algo, *scores) in ALGORITHMS
    for algo, of_seeds in whole.items():
        (*both, rate), (*spread, _) = np.mean(of_seeds, 0), np.std(of_seeds, 0, ddof=1)
        cells = " | ".join(f"{m:.1f} ± {d:.1f}" for m, d in zip(both, spread, strict=True))
        assert f"| `{algo}` | {len(of_seeds)} | {cells} | {rate:.3f} |" in PAGE
        assert "`{}` {:.1f} / {:.1f}".format(algo, *both) in sentences(README)


def test_how_many_runs_are_within_the_limit():
    runs = [RESULTS / "held_out" / path for path in campaign("held_out")]
    within = [(*held(run), last(run, 1 / 6)[1]) for run in runs]
    from_one_million, above, end = np.array(within).T
    kept_limits = sum(from_one_million <= 25), sum(end <= 25)
    said = "Of these {} runs, {} have a mean cost of at most 25 from one million steps on, and {} "
    assert said.format(len(within), *kept_limits) in sentences(PAGE)
    shares = f"{100 * above.min():.0f} to {percent(above.max())}"
    assert f"In each run {shares} of the epochs" in sentences(PAGE)
    ten = [held(run)[1] for run in runs if re.search("PointGoal1/(p|tr)po_lagr", str(run))]
    shares = f"{100 * min(ten):.0f} to {percent(max(ten))}"
    assert f", {shares} of the epochs from one million steps on" in sentences(HOLDING)


def test_how_many_episodes_exceed_the_limit_under_certified_policies():
    tests = [t for run in campaign("held_out").values() for t in run.notes.get("evaluations", ())]
    found = [test["estimates"] for test in tests if test["checkpoint"] == "certified"]
    shares = [e["over_limit_cost"]["value"] for e in found if e["episode_cost"]["value"] >= 22]
    assert np.mean(shares) == pytest.approx(1 / 3, abs=0.03)
    assert max(abs(share - 1 / 3) for share in shares) < 0.1
    said = sentences((ROOT / "docs" / "concepts.md").read_text())
    assert "whose mean cost is 22 or more, about a third of the episodes cost more than" in said


def test_what_is_said_of_pushing():
    runs = [RESULTS / "push" / "PointPush1" / "after_trpo" / f"seed{n}" for n in (401, 402, 403)]
    ends = ["{:.1f} / {:.0f}".format(*last(run, 0.25)) for run in runs]
    returns = [certificate(run, "{1:.1f}") for run in runs]
    said = sentences(PAGE)
    assert "{}, {} and {} over the last half million".format(*ends) in said
    assert "certified at returns of {}, {} and {} ".format(*returns) in said
    starts = [RESULTS / "reference" / "PointPush1" / "trpo" / f"seed{n}" for n in (0, 20)]
    ends = ["{:.1f} / {:.0f}".format(*last(run, 1 / 6)) for run in starts]
    assert "TRPO's {} and {};".format(*ends) in said


def rows_of(name):
    """Cells of a table of the page on limits, by rows."""
    page = (ROOT / "docs" / "algorithms" / "limits_measured.md").read_text()
    table = page.partition(f"<!-- table: {name} -->\n")[2].partition("\n\n")[0]
    return [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]


def ends_of_seeds(epochs, is_late):
    """Return / cost of every seed over its late epochs."""
    columns = ["episode_return", "episode_cost"]
    late = [run[is_late(run.steps)][columns] for _, run in epochs.groupby("seed")]
    return ["{:.1f} / {:.0f}".format(*run.mean()) for run in late]


@pytest.mark.parametrize("name", ["equal_seconds", "equal_steps"])
def test_worlds_and_batches(name):
    epochs = pandas.read_csv(RESULTS / "worlds" / f"{name}.csv.gz")
    shown = rows_of(name)
    assert {env for env, *_ in shown} == set(ENVIRONMENTS)
    for env, worlds, *cells in shown:
        row = epochs[(epochs.env == env) & (epochs.num_envs == int(worlds))]
        assert cells == [
            "; ".join(ends_of_seeds(cell, lambda steps: steps > 0.8 * steps.max()))
            for _, cell in row.groupby("frames_per_batch")
        ]


def test_what_each_part_contributes():
    epochs = pandas.read_csv(RESULTS / "parts" / "three_million.csv.gz")
    shown = rows_of("parts")
    assert {what.partition(":")[0] for what, *_ in shown} == set(epochs["without"])
    for what, *cells in shown:
        for env, told in zip(ENVIRONMENTS, (cells[:2], cells[2:]), strict=True):
            runs = epochs[(epochs["without"] == what.partition(":")[0]) & (epochs.env == env)]
            costs = runs[runs.steps > 1e6].groupby("seed").episode_cost
            mean, above = costs.mean().mean(), costs.agg(lambda c: (c > 25).mean()).mean()
            ends = ", ".join(ends_of_seeds(runs, lambda steps: steps > 2e6))
            assert told == [ends, f"{mean:.1f}, {percent(above)}"]


def test_the_two_runs_on_a_gpu():
    page = (ROOT / "docs" / "guides" / "gpu.md").read_text()
    for seed in (0, 1321):
        run = RESULTS / f"gpu/CarGoal1/ppo_lagrangian/seed{seed}"
        steps, *both = figures(run)
        parts = [(steps > m - 4e6) & (steps <= m) for m in (8e6, 12e6, 16e6, 20e6)]
        cells = ["{:.1f} / {:.1f}".format(*(np.nanmean(v[part]) for v in both)) for part in parts]
        assert f"| {seed} | {' | '.join([*cells, certificate(run)])} | " in page
