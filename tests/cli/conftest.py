"""What the tests of command lines share."""

import pytest
from hydra.core.config_store import ConfigStore

from safe_rl.envs import store_configs

store_configs()


@pytest.fixture(scope="module")
def few_environments():
    """Fewer environments by name: Hydra copies all of them whenever it composes."""
    repo = ConfigStore.instance().repo
    few = ("PointGoal1.yaml", "PointGoal2.yaml", "CarGoal2.yaml", "PointMass.yaml")
    kept = {name: node for name, node in repo["env"].items() if name in few}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(repo, "env", kept)
        yield
