"""Tests of pages are a step of their own: ``pytest -m docs``."""

from pathlib import Path

import pytest

import safe_rl

HERE = Path(__file__).parent
# examples in docstrings are tests of the package
OF_THE_PACKAGE = ("test_docstrings.py",)


def pytest_ignore_collect(collection_path, config):
    is_left_out = "not docs" in config.option.markexpr
    return (is_left_out and collection_path.name not in OF_THE_PACKAGE) or None


def pytest_collection_modifyitems(items):
    for item in items:
        if HERE in item.path.parents and item.path.name not in OF_THE_PACKAGE:
            item.add_marker(pytest.mark.docs)


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory):
    """A finished run of two epochs, as examples and commands want one."""
    small = {"num_envs": 2, "frames_per_batch": 40, "frames": 80, "env.num_steps": 20}
    folder = tmp_path_factory.mktemp("tiny")
    return safe_rl.train(directory=folder, logger="none", num_threads=1, **small)
