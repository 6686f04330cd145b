"""The pages of algorithms: their parts; columns and defaults are the program's."""

import re

import marks
import pytest
from commands import ROOT
from omegaconf import OmegaConf
from point_mass import PointMass
from run_configs import CONF, compose_config, off_policy_config, point_mass_config

from safe_rl.collectors import Recording
from safe_rl.runs.table import read_table
from safe_rl.training.building import build_trainer

DOCS = ROOT / "docs"
PAGE = (DOCS / "algorithms" / "index.md").read_text()
# the table of every algorithm, and those of groups of columns
OF_ALL, _, OF_GROUPS = (
    (DOCS / "algorithms" / "columns.md").read_text().partition("## Costs and limits")
)
ALGORITHMS = sorted(path.stem for path in (CONF / "algo").glob("*.yaml"))


def page_of(algo):
    return (DOCS / "algorithms" / f"{algo}.md").read_text()


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_page_has_its_parts_in_order(algo):
    page = page_of(algo)
    heads = ("## Options", "## Measured", "## When to choose it", "## What is logged")
    places = [page.find(f"\n{words}") for words in ("$$", *heads)]
    assert places == sorted(places)
    assert places[0] > 0
    assert f'--8<-- "conf/algo/{algo}.yaml"' in page
    made = dict(re.findall(r"<!-- made: (measured|single) (.*?) -->", page))
    assert made.get("measured") == algo or "single" in made or "o results yet" in page


def test_every_algorithm_is_in_the_lists():
    lists = "".join(marks.listed(r) for r in re.findall(r"made: listed (\w+)", PAGE))
    assert all(f"| [`{algo}`]({algo}.md) |" in lists for algo in ALGORITHMS)


def cells(table):
    """Cells of a table's rows, without the heading."""
    lines = [line for line in table.splitlines() if line.startswith("|")]
    return [re.split(r" ?\| ?", line)[1:-1] for line in lines[2:]]


def names_in(first_cells, costs):
    """Names of the columns that rows explain, one per cost where they say so."""
    found = [entry for cell in first_cells for entry in re.findall(r"`([^`]+)`", cell)]
    return {entry.replace("<cost>", cost) for entry in found for cost in costs}


def groups_of(algo):
    """Groups of the columns that an algorithm logs, as its page says."""
    (line,) = re.findall(r"^Groups of \[columns\].*: (.*)\.$", page_of(algo), re.M)
    return set(re.findall(r"`(\w+)`", line))


def columns_of_groups(groups, costs):
    """Names of the columns of these groups."""
    rows = [row for row in cells(OF_GROUPS) if len(row) == 3]
    assert groups <= {name for *_, names in rows for name in names.split(", ")}
    named = [first for first, _, names in rows if groups & {*names.split(", ")}]
    return names_in(named, costs)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_columns_are_those_of_a_run(algo, tmp_path):
    groups, limited, env = groups_of(algo), ["cost_hazards", "cost_north"], PointMass(4)
    documented = names_in(next(zip(*cells(OF_ALL), strict=True)), PointMass.cost_keys)
    keys = [f"algo={algo}", "frames=160"]
    if "memory" in groups:
        limited = ["cost"]
        # those of its table that begin so are of PPO
        documented = {n for n in documented if not n.startswith(("policy_", "critic_"))}
        if algo == "bc":
            Recording(tmp_path / "data", env.cost_keys).write(0, env.rollout(20))
            keys += [f"dataset.path={tmp_path / 'data'}"]
        keys += ["frames_per_batch=80", "exploration.random_steps=80", "memory.batch_size=8"]
        config = off_policy_config(*keys)
    else:
        sizes = {"minibatch_size": None if "trpo" in groups else 40}
        config = point_mass_config(*keys, "cost_limits={cost_hazards: 1, cost_north: 1}", **sizes)
    build_trainer(config, env, tmp_path / "run").run()
    found = set(read_table(tmp_path / "run" / "progress.csv"))
    assert found == documented | columns_of_groups(groups, limited)


@pytest.mark.parametrize("folder", ["", "paper/"])
def test_the_numbers_of_the_paper_beside_the_defaults(folder):
    algorithms = ("ppo_lagrangian", "cpo")
    configs = [compose_config(f"algo={folder}{algo}", "env=PointMass") for algo in algorithms]
    for key, default, paper, _ in cells(PAGE.partition("## Presets")[2]):
        value = OmegaConf.create(f"value: {paper if folder else default}").value
        assert value in [OmegaConf.select(config, key.strip("`")) for config in configs], key


def test_costs_are_estimated_as_rewards_are_but_for_what_the_table_says():
    for algo, own in (("cpo", []), ("paper/cpo", ["lmbda"])):
        config = compose_config(f"algo={algo}", "env=PointMass")
        same = ("gamma", "value_target", *own)
        assert all(config.cost_advantage[key] == config.advantage[key] for key in same)
