"""Every test here is an attack: `pytest -m attacks` runs them, and nothing else does."""

from pathlib import Path

import pytest


def pytest_ignore_collect(config):
    return "not attacks" in config.option.markexpr or None


def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.attacks)
