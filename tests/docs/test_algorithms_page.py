"""The page on the algorithms says what is so: its snippets run, its tables are the program's."""

import re

import pytest
from made import ALGORITHMS, columns_of
from omegaconf import OmegaConf
from point_mass import PointMass
from run_configs import CONF, compose_config, point_mass_config

from safe_rl.algorithms import OffPolicy
from safe_rl.algorithms.parts import find_recipe
from safe_rl.runs.table import read_table
from safe_rl.training.building import build_trainer

FOLDER = CONF.parent / "docs" / "algorithms"
PAGE = (FOLDER / "index.md").read_text()
COSTS, LIMITED = PointMass.cost_keys, ["cost_hazards", "cost_north"]


def composed(algo):
    return compose_config(f"algo={algo}", "env=PointMass")


FROM_MEMORY = {algo for algo in ALGORITHMS if find_recipe(composed(algo)) is OffPolicy}
TABLES = {algo: columns_of(algo) for algo in ALGORITHMS if algo not in FROM_MEMORY}


def test_every_algorithm_has_a_page_and_is_in_the_lists():
    assert all(f"| [`{algo}`]({algo}.md) |" in PAGE for algo in ALGORITHMS)
    page = (FOLDER.parent / "off_policy.md").read_text()
    assert all(f"| [`{algo}`](algorithms/{algo}.md) |" in page for algo in FROM_MEMORY)


def rows(name):
    """Cells of the table below its mark, without the heading."""
    table = re.search(rf"<!-- table: {name} -->\n(.*?)\n\n", PAGE, re.DOTALL)[1]
    return [re.split(r" ?\| ?", line)[1:-1] for line in table.splitlines()[2:]]


def columns(name, costs):
    """Names of the columns that a table explains, one per cost where it says so."""
    names = [found for first, *_ in rows(name) for found in re.findall(r"`([^`]+)`", first)]
    found = [entry.replace("<cost>", cost) for entry in names for cost in costs]
    return set(found)


def test_snippets_run_one_after_the_other():
    snippets = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(snippets) == 6
    exec("\n".join(snippets), {})


@pytest.mark.parametrize("algo", TABLES)
def test_the_columns_are_those_of_a_run(algo, tmp_path):
    config = point_mass_config(
        f"algo={algo}",
        "frames=480",
        "cost_limits={cost_hazards: 1, cost_north: 1}",
        minibatch_size=None if "trpo" in TABLES[algo] else 40,
    )
    build_trainer(config, PointMass(config.num_envs), tmp_path).run()
    documented = columns("columns of all", COSTS)
    for table in TABLES[algo]:
        documented |= columns(f"columns of {table}", LIMITED)
    assert set(read_table(tmp_path / "progress.csv")) == documented


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize(
    ("name", "algo"),
    [
        ("presets", "cpo"),
        ("presets of ppo_lagrangian", "ppo_lagrangian"),
        ("presets of cpo", "cpo"),
        ("presets of limits", "trpo_lagrangian"),
    ],
)
def test_the_numbers_of_the_presets(name, algo, preset):
    config = compose_config(f"preset={preset}", f"algo={algo}", "env=PointMass")
    for key, default, paper, _ in rows(name):
        value = OmegaConf.create(f"value: {default if preset == 'default' else paper}").value
        assert OmegaConf.select(config, key.strip("`")) == value, key


def test_costs_are_estimated_as_rewards_are_but_for_what_the_table_says():
    for preset, own in (("default", []), ("paper", ["lmbda"])):
        config = compose_config(f"preset={preset}", "algo=cpo", "env=PointMass")
        same = ("gamma", "value_target", *own)
        assert all(config.cost_advantage[key] == config.advantage[key] for key in same)
