"""A run of two epochs with short episodes, trained once for each file of tests."""

import shutil
from pathlib import Path

import pytest
from evaluated_runs import NUM_STEPS

import safe_rl

SMALL = {"num_envs": 4, "frames_per_batch": 160, "frames": 320, "env.num_steps": NUM_STEPS}
SMALL |= {"model.hidden_sizes": [16], "num_threads": 1, "logger": "none"}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return safe_rl.train(directory=tmp_path_factory.mktemp("runs") / "run", **SMALL).directory


@pytest.fixture
def run(trained, tmp_path):
    """A copy to write into."""
    return Path(shutil.copytree(trained, tmp_path / "run"))
