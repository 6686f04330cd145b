"""A run of two epochs, trained once for each file of tests."""

import shutil
from pathlib import Path

import pytest
from evaluated_runs import train


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train(tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def run(trained, tmp_path):
    """A copy to write into."""
    return Path(shutil.copytree(trained, tmp_path / "run"))
