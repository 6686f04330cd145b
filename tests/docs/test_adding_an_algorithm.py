"""What the page says an algorithm of one's own takes is all that it takes."""

import re
import sys

import pytest
from point_mass import PointMass
from run_configs import CONF, point_mass_config

from safe_rl import targets
from safe_rl.cli import user_code
from safe_rl.cli.user_code import import_modules
from safe_rl.runs.table import read_table
from safe_rl.training.building import build_trainer

PAGE = (CONF.parent / "docs" / "guides" / "algorithm.md").read_text()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of whose modules nothing is left behind."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(user_code, "_imported", [])
    monkeypatch.setattr(targets, "_users_modules", set())
    yield tmp_path
    del sys.modules["my_penalty"]


def test_a_loss_a_configuration_and_a_test_make_an_algorithm(folder):
    loss, test = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (configuration,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    assert sum(len(block.splitlines()) for block in (loss, configuration, test)) < 60
    (folder / "my_penalty.py").write_text(loss)
    exec(test, {})
    (folder / "my_conf" / "algo").mkdir(parents=True)
    (folder / "my_conf" / "algo" / "quadratic.yaml").write_text(configuration)
    import_modules([str(folder / "my_penalty.py")])
    config = point_mass_config(
        f"hydra.searchpath=[file://{folder / 'my_conf'}]",
        *("algo=quadratic", "frames=480", "cost_limits={cost_hazards: 1, cost_north: 0.5}"),
    )
    build_trainer(config, PointMass(config.num_envs), folder / "run").run()
    config.cost_advantage = None
    with pytest.raises(ValueError, match="is constrained and has no cost_advantage"):
        build_trainer(config, PointMass(config.num_envs), folder / "without")
    penalties = read_table(folder / "run" / "progress.csv")["policy_loss_penalty"]
    assert len(penalties) == 3
    assert max(penalties) > 0
