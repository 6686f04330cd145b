"""What holds for every test."""

import pytest

import safe_rl  # noqa: F401, has to come before torch

# isort: split
import torch
from hydra.core.config_store import ConfigStore
from hypothesis import settings

# the same examples in each run, and no deadlines: these depend on the machine
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")

# composing a configuration copies Hydra's store, with every environment, before anything is read:
# nearly half of its time; what is taken out of the store is a copy anyway
ConfigStore.__deepcopy__ = lambda store, memo: store

# as many processes as cores run tests: a second thread in each would only be in the way
torch.set_num_threads(1)


def pytest_runtest_setup(item):
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("no GPU here")


@pytest.fixture(scope="session", autouse=True)
def drawing():
    """Learning curves take a second per run: they are drawn for tests that ask for `curves`."""
    from safe_rl.runs.writing import RunWriter

    draw, RunWriter.draw_curves = RunWriter.draw_curves, lambda writer: None
    return draw


@pytest.fixture
def curves(drawing, monkeypatch):
    """For tests of what a run draws at its end."""
    monkeypatch.setattr("safe_rl.runs.writing.RunWriter.draw_curves", drawing)


@pytest.fixture
def registrations_undone():
    """For tests that register elements, tasks, costs, observations or robots."""
    from registrations import undone  # here, because it imports every environment

    with undone():
        yield


@pytest.fixture(autouse=True)
def _seed():
    """Every test starts from the same random state, whatever ran before it."""
    torch.manual_seed(0)
