"""The page on learning from memory says what is so: its columns and its defaults."""

import re

import pytest
from made import ALGORITHMS, columns_of
from omegaconf import OmegaConf
from point_mass import PointMass
from run_configs import CONF, compose_config

from safe_rl.collectors import Recording
from safe_rl.runs.table import read_table
from safe_rl.training.building import build_trainer

PAGE = (CONF.parent / "docs" / "off_policy.md").read_text()
ALL = (CONF.parent / "docs" / "algorithms" / "index.md").read_text()
COLUMNS = {algo: columns_of(algo) for algo in ALGORITHMS}
TABLES = {algo: names for algo, names in COLUMNS.items() if "memory" in names}


def columns(page, name, cost):
    """Names in the first cells of the table below a mark."""
    table = re.search(rf"<!-- table: {name} -->\n(.*?)\n\n", page, re.DOTALL)[1]
    first = [line.split("|")[1] for line in table.splitlines()[2:]]
    return {c.replace("<cost>", cost) for cell in first for c in re.findall(r"`([^`]+)`", cell)}


@pytest.mark.parametrize("algo", TABLES)
def test_the_columns_are_those_of_a_run(algo, tmp_path):
    sizes = ["frames=160", "num_envs=4", "frames_per_batch=80", "memory.batch_size=8"]
    keys = [f"algo={algo}", "env=PointMass", "logger=none", "policy_update.updates_per_step=0.05"]
    if algo == "bc":
        env = PointMass(4)
        Recording(tmp_path / "data", env.cost_keys).write(0, env.rollout(20))
        keys += [f"dataset.path={tmp_path / 'data'}"]
    config = compose_config(*keys, "exploration.random_steps=80", *sizes)
    build_trainer(config, PointMass(4), tmp_path).run()
    documented = set.union(*(columns(ALL, "columns of all", key) for key in PointMass.cost_keys))
    # those of its table that begin so are of PPO
    documented = {name for name in documented if not name.startswith(("policy_", "critic_"))}
    for name in TABLES[algo]:
        documented |= columns(PAGE, f"columns of {name}", "cost")
    assert set(read_table(tmp_path / "progress.csv")) == documented


def test_the_defaults_are_those_of_the_files():
    config = compose_config("algo=sac_lagrangian", "env=PointMass")
    rows = re.findall(r"^\| (`.+?) \| ([^|]+) \|", PAGE, re.MULTILINE)
    known = {}
    for keys, default in rows:
        names = re.findall(r"`([^`]+)`", keys)
        if "." in names[0]:
            known |= dict(zip(names, re.split(r", (?!0)", default), strict=False))
    assert len(known) > 12
    for key, default in known.items():
        found = OmegaConf.select(config, key)
        shown = default.partition(";")[0].strip("` ").replace(",", "")
        if "TD3" not in default or ";" in default:
            assert found == OmegaConf.create(f"value: {shown}").value, key
