"""What the pages on all algorithms say: snippets run, columns and defaults are the program's."""

import re

import marks
import pytest
from made import ALGORITHMS, DOCS, columns_of
from omegaconf import OmegaConf
from point_mass import PointMass
from run_configs import compose_config, point_mass_config

from safe_rl.collectors import Recording
from safe_rl.runs.table import read_table
from safe_rl.training.building import build_trainer

PAGE = (DOCS / "algorithms" / "index.md").read_text()
# the table of every algorithm, and those of groups of columns
OF_ALL, _, OF_GROUPS = (
    (DOCS / "algorithms" / "columns.md").read_text().partition("## Costs and limits")
)
LIMITED = ["cost_hazards", "cost_north"]
OFF_POLICY = [algo for algo in ALGORITHMS if "memory" in columns_of(algo)]


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


def columns_of_groups(algo, costs):
    """Names of the columns of the groups that an algorithm's page names."""
    rows = [row for row in cells(OF_GROUPS) if len(row) == 3]
    groups = set(columns_of(algo))
    assert groups <= {name for *_, names in rows for name in names.split(", ")}
    named = [first for first, _, names in rows if groups & {*names.split(", ")}]
    return names_in(named, costs)


def columns_of_a_run(config, folder):
    build_trainer(config, PointMass(config.num_envs), folder).run()
    return set(read_table(folder / "progress.csv"))


@pytest.mark.parametrize("algo", [algo for algo in ALGORITHMS if algo not in OFF_POLICY])
def test_the_columns_are_those_of_a_run(algo, tmp_path):
    config = point_mass_config(
        f"algo={algo}",
        "frames=160",
        "cost_limits={cost_hazards: 1, cost_north: 1}",
        minibatch_size=None if "trpo" in columns_of(algo) else 40,
    )
    documented = names_in(next(zip(*cells(OF_ALL), strict=True)), PointMass.cost_keys)
    documented |= columns_of_groups(algo, LIMITED)
    assert columns_of_a_run(config, tmp_path) == documented


@pytest.mark.parametrize("algo", OFF_POLICY)
def test_the_columns_are_those_of_an_off_policy_run(algo, tmp_path):
    sizes = ["frames=160", "num_envs=4", "frames_per_batch=80", "memory.batch_size=8"]
    keys = [f"algo={algo}", "env=PointMass", "logger=none", "policy_update.updates_per_step=0.05"]
    if algo == "bc":
        env = PointMass(4)
        Recording(tmp_path / "data", env.cost_keys).write(0, env.rollout(20))
        keys += [f"dataset.path={tmp_path / 'data'}"]
    config = compose_config(*keys, "exploration.random_steps=80", *sizes)
    documented = names_in(next(zip(*cells(OF_ALL), strict=True)), PointMass.cost_keys)
    # those of its table that begin so are of PPO
    documented = {name for name in documented if not name.startswith(("policy_", "critic_"))}
    documented |= columns_of_groups(algo, ["cost"])
    assert columns_of_a_run(config, tmp_path) == documented


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
